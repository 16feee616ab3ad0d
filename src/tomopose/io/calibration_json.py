"""calibration.json: a calibration with everything that is needed to use it, to judge it, and to load it unchanged."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tomopose.calibration.result import Calibration, Observability, Parameter
from tomopose.coverage import expanded_k2
from tomopose.errors import FileError, InputError
from tomopose.files import read_json, require_absent, write_json
from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import rotation_angle_between, rotation_from_angles
from tomopose.geometry.scanner import PARAMETER_UNITS
from tomopose.geometry.transforms import RigidTransform
from tomopose.io.numbers_json import decode_array, encode
from tomopose.io.scanner_json import scanner_document, scanner_from_document
from tomopose.provenance import Provenance

ANGLES_TOLERANCE = 1e-9


def write_calibration(path: str | Path, cal: Calibration, *, force: bool = False) -> None:
    """Write calibration.json; `read_calibration` gives back every number bit for bit.

    `manipulator`, `hypotheses` and `extra` hold what JSON knows: text, numbers, lists, objects; in them numbers that
    are not finite become null.  FileError if the file exists and `force` is not given.
    """
    write_json(require_absent(path, force=force), "calibration", calibration_document(cal))


def calibration_document(cal: Calibration) -> dict[str, Any]:
    """The JSON object of a calibration, without its schema."""
    units = tangent_units(cal)
    return {
        "verdict": cal.verdict,
        "reasons": cal.reasons,
        "status": cal.status,
        "converged": cal.converged,
        "T_HT": {"matrix": cal.T_HT.matrix, "angles_rad": cal.T_HT.angles, "t_mm": cal.T_HT.t},
        "ball_ids": list(cal.balls),
        "t_mm": [encode(t) for t in cal.balls.values()],
        "parameters": [
            {
                "name": p.name,
                "value": encode(p.value),
                "unit": p.unit,
                "standard_uncertainty": encode(p.u),
                "expanded_uncertainty_k2": encode(expanded_k2(p.u)),
            }
            for p in cal.parameters
        ],
        "covariance": {"names": cal.tangent, "units": units, "matrix": encode(cal.covariance)},
        "d_rms_px": cal.d_rms if len(cal.pose_id) else None,
        "d_rms_um": cal.d_rms_um if len(cal.pose_id) else None,
        "chi2": encode(cal.chi2),
        "dof": cal.dof,
        "chi2_dof": cal.chi2_dof,
        "model": cal.model,
        "manipulator": cal.manipulator,
        "observability": {
            "singular_values": encode(np.asarray(cal.observability.singular_values)),
            "condition": cal.observability.condition,
            "unobservable": cal.observability.unobservable,
            "notes": cal.observability.notes,
        },
        "hypotheses": cal.hypotheses,
        "pivot_mm": cal.pivot,
        "convention": cal.convention,
        "scanner": {"schema": "tomopose/scanner/1", **scanner_document(cal.scanner)},
        "residuals": {
            "pose_id": cal.pose_id,
            "u_px": encode(cal.x_D[:, 0]),
            "v_px": encode(cal.x_D[:, 1]),
            "residual_u_px": encode(cal.residuals[:, 0]),
            "residual_v_px": encode(cal.residuals[:, 1]),
            "d_px": encode(cal.d),
        },
        "outliers": cal.outliers,
        "extra": cal.extra,
        "provenance": None if cal.provenance is None else cal.provenance.to_json(),
    }


def tangent_units(cal: Calibration) -> list[str]:
    """The units of the coordinates of the covariance: those of the parameter of that name, else by the name."""
    named = {p.name: p.unit for p in cal.parameters}

    def unit(name: str) -> str:
        if name.startswith("w_HT"):
            return "rad"
        if name.startswith(("t_", "t[")):
            return "mm"
        return PARAMETER_UNITS.get(name, named.get(name, ""))

    return [unit(name) for name in cal.tangent]


def read_calibration(path: str | Path) -> Calibration:
    """Read calibration.json.

    Raises FileError or SchemaVersionError where it is no such file, InputError where a part is missing or does not fit.
    """
    document = read_json(path, "calibration")
    try:
        return _calibration(document, str(path))
    except KeyError as error:
        raise InputError(f"{path}: the key {error} is missing") from error
    except InputError as error:
        raise error if str(error).startswith(str(path)) else InputError(f"{path}: {error}") from error
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        raise FileError(f"{path} is damaged: {error}", path=path) from error


def _calibration(document: Mapping[str, Any], where: str) -> Calibration:
    residuals, covariance = document["residuals"], document["covariance"]
    observability, provenance = document["observability"], document.get("provenance")
    ball_ids, t, pivot = document["ball_ids"], document["t_mm"], document.get("pivot_mm")
    if len(ball_ids) != len(t):
        raise InputError(f"{where}: {len(ball_ids)} ball_ids but {len(t)} rows of t_mm")
    m, n = len(covariance["names"]), len(residuals["pose_id"])

    def columns(u: str, v: str) -> Any:
        return np.column_stack([decode_array(residuals[u], n), decode_array(residuals[v], n)])

    return Calibration(
        scanner=scanner_from_document(document["scanner"], f"{where}: scanner"),
        T_HT=_T_HT(document["T_HT"], where),
        balls={int(k): decode_array(row, 3) for k, row in zip(ball_ids, t, strict=True)},
        tangent=tuple(covariance["names"]),
        covariance=decode_array(covariance["matrix"], m, m),
        pose_id=tuple(residuals["pose_id"]),
        x_D=columns("u_px", "v_px"),
        residuals=columns("residual_u_px", "residual_v_px"),
        chi2=float(decode_array(document["chi2"])),
        dof=int(document["dof"]),
        parameters=tuple(
            Parameter(
                name=p["name"],
                value=float(decode_array(p["value"])),
                u=float(decode_array(p["standard_uncertainty"])),
                unit=p["unit"],
            )
            for p in document["parameters"]
        ),
        observability=Observability(
            singular_values=decode_array(observability["singular_values"], -1),
            unobservable=tuple(observability["unobservable"]),
            notes=tuple(observability["notes"]),
        ),
        outliers=dict(document["outliers"]),
        model=document["model"],
        manipulator=dict(document["manipulator"]),
        converged=bool(document["converged"]),
        status=document["status"],
        verdict=document["verdict"],
        reasons=tuple(document["reasons"]),
        hypotheses=tuple(document["hypotheses"]),
        pivot=None if pivot is None else decode_array(pivot, 3),
        convention=document["convention"],
        extra=dict(document["extra"]),
        provenance=None if provenance is None else Provenance.from_json(provenance),
    )


def _T_HT(block: Mapping[str, Any], where: str) -> RigidTransform:
    T_HT = RigidTransform.from_matrix(decode_array(block["matrix"], 4, 4), source=Frame.H, target=Frame.T)
    angles, t = decode_array(block["angles_rad"], 3), decode_array(block["t_mm"], 3)
    off = float(rotation_angle_between(rotation_from_angles(angles), T_HT.R))
    if off > ANGLES_TOLERANCE or not np.array_equal(t, T_HT.t):
        raise InputError(
            f"{where}: T_HT.matrix and T_HT.angles_rad, t_mm contradict each other (by {off:.3g} rad and "
            f"{float(np.abs(t - T_HT.t).max()):.3g} mm); the file was edited"
        )
    return T_HT
