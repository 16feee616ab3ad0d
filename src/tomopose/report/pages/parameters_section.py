"""What a calibration found: parameters with uncertainty and units, the mount in both directions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tomopose.calibration.result import Calibration, Parameter
from tomopose.coverage import expanded_k2
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.error_models import moving_scanner
from tomopose.report.page import Block, Section, Table, Words
from tomopose.report.words import NOT_GIVEN, cell, heading, meaning, small_unit
from tomopose.units import value_with_uncertainty

MANY_PARAMETERS = 12
MACHINE_LISTS = ("names", "values", "units", "u", "nominal")
"""Parts of `Calibration.manipulator` that stand in the tables of parameters already, or in its input file."""


def parameters_section(calibration: Calibration) -> Section:
    """Values with uncertainty and units, both directions of the mount, the manipulator's errors, the pivot."""
    names = calibration.manipulator.get("names")
    machine = set(names) if isinstance(names, (list, tuple)) else set()
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
                "that the poses cannot tell stay near zero with the uncertainty of their prior.",
            )
        )
    facts = [[heading(k), cell(v)] for k, v in calibration.manipulator.items() if k not in MACHINE_LISTS]
    if facts:
        blocks.append(Table(title="The manipulator's model", meaning="", columns=["", ""], rows=facts))
    pivot = NOT_GIVEN if calibration.pivot is None else ", ".join(f"{x:.4f}" for x in calibration.pivot) + " mm"
    blocks.append(
        Words(
            items=[
                f"Pivot of the controller: {pivot}. A scan with another pivot needs another calibration.",
                "T_AB takes coordinates in A to coordinates in B. Angles are those of R = R_x R_y R_z.",
            ]
        )
    )
    carried = moving_scanner(calibration.manipulator) or calibration.manipulator.get("kind") == "twin"
    lead = (
        "How the scanner sits on the moved plate, and where the ball stands."
        if carried
        else "How the manipulator sits on the table, and where the ball is."
    )
    return Section(title="What was found", lead=lead, blocks=blocks)


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
