"""Findings, models compared, poses held out, drift and steps: what a calibration found out about itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np

from tomopose.calibration.checks.stability import Stability
from tomopose.calibration.result import Calibration, ModelComparison, RotationResiduals
from tomopose.geometry.scanner import PARAMETER_UNITS
from tomopose.report.figures.halves_figure import halves_map
from tomopose.report.page import Block, Figure, Section, Table, Words
from tomopose.report.style import ACCENT, ORANGE, SOFT, axis, layout
from tomopose.report.words import cell, number

MODEL_COLOURS: Mapping[str, str] = MappingProxyType({"rigid": "#9dbfdd", "kinematic": ACCENT, "slack": ORANGE})


def findings_table(calibration: Calibration) -> list[Section]:
    """Everything that the rules found, with what it was compared with and what to do; none where nothing was found."""
    if not calibration.checks:
        return []
    table = Table(
        title="What the checks found",
        meaning="Each rule compares a value with its limit. The worst finding is the verdict.",
        columns=["rule", "finding", "value", "limit", "what to do", "verdict"],
        rows=[[f.rule, f.words, cell(f.value), cell(f.limit), f.remedy or "–", f.verdict] for f in calibration.checks],
        numeric=(2, 3),
    )
    return [
        Section(
            title="Findings", lead="What speaks against this calibration, and what is worth knowing.", blocks=[table]
        )
    ]


def checks_section(calibration: Calibration) -> Section | None:
    """The section, or None where the calibration holds no such results."""
    blocks: list[Block] = []
    compared = calibration.comparison
    if compared is not None:
        blocks.append(_models(compared))
        if compared.by_rotation:
            blocks.append(models_by_rotation(compared.by_rotation))
    if calibration.stability is not None:
        blocks += _stability(calibration.stability)
    if calibration.halves is not None:
        blocks.append(halves_map(calibration.halves))
    words = list(_noise_words(calibration))
    if words:
        blocks.append(Words(title="Noise", items=words))
    blocks += _runs(calibration)
    if not blocks:
        return None
    return Section(
        title="Models and checks",
        lead="Which model the data support, and whether everything kept its place while the images were taken.",
        blocks=blocks,
    )


def _models(compared: ModelComparison) -> Table:
    return Table(
        title="Models compared",
        meaning="Held-out poses were predicted without having been fitted: a model that only fits better is not "
        "better. Evidence weighs fit against the number of parameters.",
        columns=["model", "d_rms / px", "held-out poses / px", "χ²/dof", "log evidence", "log predictive", ""],
        rows=[
            [
                m.model,
                *(cell(v) for v in (m.d_rms, m.cv_rms, m.chi2_dof, m.log_evidence, m.log_predictive)),
                "chosen" if m.model == compared.chosen else "",
            ]
            for m in compared.models
        ],
        numeric=range(1, 6),
    )


def models_by_rotation(rows: Sequence[RotationResiduals]) -> Figure:
    """rms residual of each model by rotation axis: fig. 8 (b) before and after the manipulator's own errors."""
    names = list(rows[0].px)
    rotations = [r.rotation.replace("-", "−") for r in rows]
    return Figure(
        title="Residuals by rotation, model by model",
        meaning="rms distance between detected and calculated centre for the poses of each rotation axis.",
        look_for="A model that explains the manipulator brings all bars to the height of those without rotation.",
        data=[
            {
                "type": "bar",
                "name": name,
                "x": rotations,
                "y": [row.px.get(name) for row in rows],
                "marker": {"color": MODEL_COLOURS.get(name, SOFT)},
                "hovertemplate": f"{name}, rotation %{{x}}: %{{y:.4f}} px<extra></extra>",
            }
            for name in names
        ],
        layout=layout(
            xaxis=axis("rotation", type="category"),
            yaxis=axis("d_rms / px", rangemode="tozero"),
            barmode="group",
            bargap=0.35,
        ),
        height=330,
    )


def _stability(found: Stability) -> list[Block]:
    blocks: list[Block] = []
    if np.isfinite(found.held_out_rms):
        sentence = (
            f"Poses left out of the fit are predicted to {number(found.held_out_rms)} px rms; the fit leaves "
            f"{number(found.fit_rms)} px. In units of the predicted uncertainty the square of the miss is "
            f"{number(found.held_out_chi2)} (1 is right)."
        )
        blocks.append(Words(title="Held-out poses", paragraphs=[sentence]))
    if found.effects:
        blocks.append(
            Table(
                title="Did everything keep its place?",
                meaning="Drift and steps, with the probability that chance alone makes one as large.",
                columns=["effect", "what it would be", "size / px", "probability by chance", "at pose"],
                rows=[[e.name, e.words, cell(e.size_px), probability(e.p), e.at or "–"] for e in found.effects],
                numeric=(2, 3),
            )
        )
    if found.repeats:
        blocks.append(
            Table(
                title="Poses taken twice",
                meaning="How far the ball's centre came back to where it had been.",
                columns=["first", "again", "distance / px", "sigmas"],
                rows=[[r.first, r.again, cell(r.distance_px), cell(r.sigmas)] for r in found.repeats],
                folded=len(found.repeats) > 12,
            )
        )
    return blocks


def probability(p: float) -> str:
    if not np.isfinite(p):
        return "–"
    return "below 0.0001" if p < 1e-4 else f"{p:.4f}" if p < 0.1 else f"{p:.2f}"


def _noise_words(calibration: Calibration) -> list[str]:
    words = []
    if np.isfinite(calibration.expected_residual):
        words.append(f"The stated uncertainties explain a residual of {number(calibration.expected_residual)} px.")
    if calibration.widening != 1.0:
        words.append(
            f"All uncertainties were widened by the factor {number(np.sqrt(calibration.widening))}, since the "
            "residuals are larger than the stated noise."
        )
    noise = calibration.pose_noise
    if noise is not None:
        words.append(
            f"Pose noise was found beside detection noise: {number(noise.translation_mm * 1e3)} µm and "
            f"{number(noise.rotation_rad * 1e6)} µrad; χ²/dof falls from {number(noise.chi2_dof_without)} to "
            f"{number(noise.chi2_dof_with)}."
        )
    return words


def _runs(calibration: Calibration) -> list[Block]:
    """The scanner of each run, and d_SD of each view, where there are several."""
    blocks: list[Block] = []
    if calibration.runs:
        names = list(PARAMETER_UNITS)
        blocks.append(
            Table(
                title="Scanner of each run",
                meaning="The runs share the mount and the balls.",
                columns=["run", *(f"{name} / {unit}" for name, unit in PARAMETER_UNITS.items())],
                rows=[[str(k), *(cell(getattr(s, n)) for n in names)] for k, s in enumerate(calibration.runs)],
                numeric=range(1, 1 + len(names)),
            )
        )
    views = calibration.views
    if views is not None:
        blocks.append(
            Table(
                title="Source to detector, view by view",
                meaning=f"d_SD scatters by {number(views.sigma)} mm from view to view.",
                columns=["pose", "d_SD / mm", "u / mm"],
                rows=[
                    [pose, f"{d:.4f}", cell(u)] for pose, d, u in zip(views.pose_id, views.d_SD, views.u, strict=True)
                ],
                numeric=(1, 2),
                folded=len(views.pose_id) > 20,
            )
        )
    return blocks
