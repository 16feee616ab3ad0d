"""What a calibration found: parameters with uncertainty and units, the mount in both directions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tomopose.calibration.model.assumed import Assumed
from tomopose.calibration.result import Calibration, Parameter
from tomopose.coverage import expanded_k2
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.error_models import RigidErrors, TwinErrors
from tomopose.report.page import Block, Section, Table, Words
from tomopose.report.words import NOT_GIVEN, cell, meaning, small_unit
from tomopose.units import value_with_uncertainty

MANY_PARAMETERS = 12


def parameters_section(calibration: Calibration) -> Section:
    """Values with uncertainty and units, both directions of the mount, the manipulator's errors, the pivot."""
    errors_found = calibration.errors
    machine = set() if isinstance(errors_found, RigidErrors) else set(errors_found.names)
    T_HT = calibration.T_HT
    blocks: list[Block] = [
        _parameter_table(
            [p for p in calibration.parameters if p.name not in machine],
            title="Parameters",
            words="The figures in brackets are the standard uncertainty in units of the last digits; U is the expanded "
            "uncertainty, k = 2.",
        ),
        _transform_table(T_HT, "T_HT: from the manipulator's base H to the table T"),
        _transform_table(T_HT.inv, "T_TH: from the table T to the manipulator's base H"),
    ]
    errors = [p for p in calibration.parameters if p.name in machine]
    if errors:
        blocks.append(
            _parameter_table(
                errors,
                title="Identified errors of the manipulator",
                words="What the model found beside the mount, as corrections of the machine's stated geometry. Errors "
                "that the poses do not determine stay near zero with the uncertainty of their prior.",
            )
        )
    facts = _facts(calibration)
    if facts:
        blocks.append(Table(title="The manipulator's model", meaning="", columns=["", ""], rows=facts))
    if calibration.assumed:
        blocks.append(_assumed_table(calibration.assumed))
    pivot = NOT_GIVEN if calibration.pivot is None else ", ".join(f"{x:.4f}" for x in calibration.pivot) + " mm"
    blocks.append(
        Words(
            items=[
                f"Pivot of the controller: {pivot}. A scan with another pivot needs another calibration.",
                "T_AB takes coordinates in A to coordinates in B. Angles are those of R = R_x R_y R_z.",
            ]
        )
    )
    lead = "How the manipulator sits on the table, and where the ball is."
    if calibration.inverse:
        lead = "How the scanner sits on the moved plate, and where the ball is."
    elif calibration.arrangement == "turntable":
        lead = "The panel against the table's axis, and where the balls are on the table; T_HT is the identity."
    return Section(title="What was found", lead=lead, blocks=blocks)


def _facts(calibration: Calibration) -> list[list[str]]:
    """What is known of the manipulator beside the errors themselves."""
    errors = calibration.errors
    facts = [["arrangement", calibration.arrangement]] if calibration.inverse else []
    if isinstance(errors, TwinErrors):
        facts.append(["model", "twin robots"])
    else:
        if not isinstance(errors, RigidErrors):
            facts.append(["model", errors.machine.kind])
            if errors.lag is not None:
                facts += [
                    [name, f"{value:.4g} mm"] for name, value in zip(errors.lag.names, errors.lag.values, strict=True)
                ]
        if errors.translation_scale != 1.0:
            facts.append(["scale of the translations", f"{errors.translation_scale:.9g}"])
    if errors.scatter is not None:
        t = ", ".join(f"{1e3 * x:.3g}" for x in errors.scatter.t)
        w = ", ".join(f"{1e6 * x:.3g}" for x in errors.scatter.w)
        facts.append(["scatter from pose to pose along x, y, z", f"{t} µm; {w} µrad"])
    return facts


def _assumed_table(assumed: Sequence[Assumed]) -> Table:
    return Table(
        title="What was assumed",
        meaning="Taken with a standard uncertainty rather than measured here; it is part of every uncertainty above.",
        columns=["parameter", "what it is", "standard uncertainty", "from"],
        rows=[[a.name, meaning(a.name), f"{cell(a.sigma)} {a.unit}".strip(), a.source] for a in assumed],
        numeric=(2,),
    )


def _parameter_table(parameters: Sequence[Parameter], *, title: str, words: str) -> Table:
    rows = []
    for p in parameters:
        degrees = f"{np.degrees(p.value):.6f}°" if p.unit == "rad" else ""
        rows.append(
            [
                p.name,
                meaning(p.name),
                value_with_uncertainty(p.value, p.u, p.unit),
                degrees,
                small_unit(p.u, p.unit),
                small_unit(expanded_k2(p.u), p.unit),
            ]
        )
    return Table(
        title=title,
        meaning=words,
        columns=["parameter", "what it is", "value", "in degrees", "u", "U (k = 2)"],
        rows=rows,
        numeric=(2, 3, 4, 5),
        folded=len(rows) > 2 * MANY_PARAMETERS,
    )


def _transform_table(T: RigidTransform, title: str) -> Table:
    angles = ", ".join(f"{a:.5f}°" for a in np.degrees(T.angles))
    return Table(
        title=title,
        meaning=f"Angles {angles}; t in mm.",
        columns=["R", "", "", "t / mm"],
        rows=[[*(f"{x:.9f}" for x in T.R[k]), f"{T.t[k]:.6f}"] for k in range(3)],
        numeric=(0, 1, 2, 3),
        wide=False,
    )
