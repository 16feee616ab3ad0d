"""calibration.json: a calibration with everything that is needed to use it, to judge it, and to load it unchanged.

Schema 2 is written; schema 1 is read for ever (`calibration.version_1` translates it).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tomopose.calibration.result import SCANNER_MOVES, Calibration, Parameter
from tomopose.calibration.rigid.observability import Observability
from tomopose.coverage import expanded_k2
from tomopose.errors import FileError, InputError
from tomopose.files import read_json, require_absent, warn_if_edited, write_json
from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import rotation_angle_between, rotation_from_angles
from tomopose.geometry.scanner import PARAMETER_UNITS
from tomopose.geometry.transforms import RigidTransform
from tomopose.io.calibration import assumptions, checks_blocks
from tomopose.io.calibration.errors_block import errors_document, errors_from_document
from tomopose.io.calibration.version_1 import as_version_2
from tomopose.io.numbers_json import decode_array, encode
from tomopose.io.scanner_json import scanner_document, scanner_from_document
from tomopose.provenance import Provenance
from tomopose.reading import reader
from tomopose.reading.contradictions import require_consistent_calibration
from tomopose.values import require_types

VERSION = 2
ANGLES_TOLERANCE = 1e-9


@require_types
def write_calibration(path: str | Path, cal: Calibration, *, force: bool = False) -> None:
    """Write calibration.json; `read_calibration` gives back every number bit for bit.

    FileError if the file exists and `force` is not given.
    """
    write_json(require_absent(path, force=force), "calibration", calibration_document(cal), version=VERSION)


def calibration_document(cal: Calibration) -> dict[str, Any]:
    """The JSON object of a calibration, without its schema."""
    return {
        "verdict": cal.verdict,
        "reasons": cal.reasons,
        "findings": [checks_blocks.finding_document(f) for f in cal.checks],
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
        "priors": {name: encode(sigma) for name, sigma in cal.priors.items()},
        **assumptions.document(cal),
        "covariance": {"names": cal.tangent, "units": tangent_units(cal), "matrix": encode(cal.covariance)},
        "d_rms_px": cal.d_rms if len(cal.pose_id) else None,
        "d_rms_um": cal.d_rms_um if len(cal.pose_id) else None,
        "magnification_at_ball": cal.magnification_at_ball,
        "expected_residual_px": encode(cal.expected_residual),
        "widening": encode(cal.widening),
        "chi2": encode(cal.chi2),
        "dof": cal.dof,
        "chi2_dof": cal.chi2_dof,
        "model": cal.model,
        "arrangement": cal.arrangement,
        "manipulator": errors_document(cal.errors),
        "observability": {
            "singular_values": encode(np.asarray(cal.observability.singular_values)),
            "condition": cal.observability.condition,
            "unobservable": cal.observability.unobservable,
            "notes": cal.observability.notes,
        },
        "hypotheses": [checks_blocks.hypothesis_document(h) for h in cal.hypotheses],
        "stability": None if cal.stability is None else checks_blocks.stability_document(cal.stability),
        "comparison": None if cal.comparison is None else checks_blocks.comparison_document(cal.comparison),
        "pose_noise": None if cal.pose_noise is None else checks_blocks.flat(cal.pose_noise),
        "views": None if cal.views is None else checks_blocks.views_document(cal.views),
        "pivot_mm": cal.pivot,
        "convention": cal.convention,
        "scanner": _scanner(cal.scanner),
        "runs": [_scanner(s) for s in cal.runs],
        "residuals": {
            "pose_id": cal.pose_id,
            "u_px": encode(cal.x_D[:, 0]),
            "v_px": encode(cal.x_D[:, 1]),
            "residual_u_px": encode(cal.residuals[:, 0]),
            "residual_v_px": encode(cal.residuals[:, 1]),
            "d_px": encode(cal.d),
        },
        "outliers": cal.outliers,
        "not_seen": cal.not_seen,
        "provenance": None if cal.provenance is None else cal.provenance.to_json(),
    }


def _scanner(scanner: Any) -> dict[str, Any]:
    return {"schema": "tomopose/scanner/1", **scanner_document(scanner)}


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


@reader("calibration.json")
def read_calibration(path: str | Path) -> Calibration:
    """Read calibration.json.

    Raises FileError or SchemaVersionError where it is no such file, InputError where a part is missing or does not fit.
    """
    document = read_json(path, "calibration", version=VERSION)
    version = int(str(document["schema"]).rpartition("/")[2])
    require_consistent_calibration(document, str(path), version=version)
    try:
        found = _calibration(as_version_2(document), str(path))
    except KeyError as error:
        raise InputError(f"{path}: the key {error} is missing") from error
    except InputError as error:
        raise error if str(error).startswith(str(path)) else InputError(f"{path}: {error}") from error
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        raise FileError(f"{path} is damaged: {error}", path=path) from error
    warn_if_edited(document, path)
    return found


def _calibration(document: Mapping[str, Any], where: str) -> Calibration:
    residuals, covariance = document["residuals"], document["covariance"]
    observability, provenance = document["observability"], document.get("provenance")
    ball_ids, t, pivot = document["ball_ids"], document["t_mm"], document.get("pivot_mm")
    stability, comparison, views = (document.get(k) for k in ("stability", "comparison", "views"))
    if len(ball_ids) != len(t):
        raise InputError(f"{where}: {len(ball_ids)} ball_ids but {len(t)} rows of t_mm")
    m, n = len(covariance["names"]), len(residuals["pose_id"])

    def columns(u: str, v: str) -> Any:
        return np.column_stack([decode_array(residuals[u], n), decode_array(residuals[v], n)])

    noise = document.get("pose_noise")
    result = Calibration(
        scanner=scanner_from_document(document["scanner"], f"{where}: scanner"),
        T_HT=_T_HT(document["T_HT"], where),
        balls={int(k): decode_array(row, 3) for k, row in zip(ball_ids, t, strict=True)},
        tangent=tuple(covariance["names"]),
        covariance=decode_array(covariance["matrix"], m, m),
        pose_id=tuple(residuals["pose_id"]),
        x_D=columns("u_px", "v_px"),
        residuals=columns("residual_u_px", "residual_v_px"),
        chi2=_number(document["chi2"]),
        dof=int(document["dof"]),
        parameters=tuple(
            Parameter(
                name=p["name"],
                value=_number(p["value"]),
                u=_number(p["standard_uncertainty"]),
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
        not_seen=dict(document["not_seen"]),
        model=document["model"],
        arrangement=document["arrangement"],
        errors=errors_from_document(document["manipulator"], inverse=document["arrangement"] in SCANNER_MOVES),
        priors={name: _number(sigma) for name, sigma in document["priors"].items()},
        **assumptions.from_document(document, m),
        converged=bool(document["converged"]),
        status=document["status"],
        checks=tuple(checks_blocks.finding_from(f) for f in document["findings"]),
        hypotheses=tuple(checks_blocks.hypothesis_from(h) for h in document["hypotheses"]),
        stability=None if stability is None else checks_blocks.stability_from(stability),
        comparison=None if comparison is None else checks_blocks.comparison_from(comparison),
        pose_noise=None if noise is None else checks_blocks.pose_noise_from(noise),
        views=None if views is None else checks_blocks.views_from(views),
        widening=_number(document["widening"]),
        expected_residual=_number(document["expected_residual_px"]),
        magnification_at_ball=None
        if document.get("magnification_at_ball") is None
        else float(document["magnification_at_ball"]),
        runs=tuple(scanner_from_document(s, f"{where}: runs") for s in document["runs"]),
        pivot=None if pivot is None else decode_array(pivot, 3),
        convention=document["convention"],
        provenance=None if provenance is None else Provenance.from_json(provenance),
    )
    if result.verdict != document["verdict"]:
        raise InputError(
            f"{where}: verdict {document['verdict']!r} is not that of the findings, {result.verdict!r}; the file was "
            "edited"
        )
    return result


def _number(value: object) -> float:
    return float(decode_array(value))


def _T_HT(block: Mapping[str, object], where: str) -> RigidTransform:
    T_HT = RigidTransform.from_matrix(decode_array(block["matrix"], 4, 4), source=Frame.H, target=Frame.T)
    angles, t = decode_array(block["angles_rad"], 3), decode_array(block["t_mm"], 3)
    off = float(rotation_angle_between(rotation_from_angles(angles), T_HT.R))
    if off > ANGLES_TOLERANCE or not np.array_equal(t, T_HT.t):
        raise InputError(
            f"{where}: T_HT.matrix and T_HT.angles_rad, t_mm contradict each other (by {off:.3g} rad and "
            f"{float(np.abs(t - T_HT.t).max()):.3g} mm); the file was edited"
        )
    return T_HT
