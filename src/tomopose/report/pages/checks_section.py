"""Models compared, poses held out, drift and steps: what a calibration found out about itself (`Calibration.extra`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from tomopose.calibration.result import Calibration
from tomopose.report.page import Block, Figure, Section, Table, Words
from tomopose.report.style import ACCENT, ORANGE, SOFT, axis, layout
from tomopose.report.words import cell, heading, number

MODEL_COLOURS: Mapping[str, str] = MappingProxyType({"rigid": "#9dbfdd", "kinematic": ACCENT, "slack": ORANGE})
MODEL_HEADINGS: Mapping[str, str] = MappingProxyType(
    {
        "model": "model",
        "d_rms_px": "d_rms / px",
        "cv_rms_px": "held-out poses / px",
        "chi2_dof": "χ²/dof",
        "log_evidence": "log evidence",
        "log_predictive": "log predictive",
    }
)
KNOWN = (
    "integrity",
    "models",
    "model_chosen",
    "by_rotation",
    "pose_noise",
    "widening",
    "expected_residual_px",
    "not_seen",
)


def checks_section(calibration: Calibration) -> Section | None:
    """The section, or None where the calibration holds no such results.

    What this page does not know is shown too, as plain tables.
    """
    extra = calibration.extra
    blocks: list[Block] = []
    if isinstance(extra.get("models"), Sequence):
        blocks.append(_models(extra["models"], str(extra.get("model_chosen", calibration.model))))
    if isinstance(extra.get("by_rotation"), Sequence) and extra["by_rotation"]:
        blocks.append(models_by_rotation(extra["by_rotation"]))
    if isinstance(extra.get("integrity"), Mapping):
        blocks += _integrity(extra["integrity"])
    words = list(_noise_words(extra))
    if words:
        blocks.append(Words(title="Noise", items=words))
    blocks += [t for key, value in extra.items() if key not in KNOWN and (t := _plain(key, value)) is not None]
    if not blocks:
        return None
    return Section(
        title="Models and checks",
        lead="Which model the data support, and whether everything stood still while the images were taken.",
        blocks=blocks,
    )


def _models(models: Sequence[Mapping[str, Any]], chosen: str) -> Table:
    columns = [c for c in MODEL_HEADINGS if any(c in m for m in models)]
    rows = []
    for m in models:
        row = [cell(m.get(c)) for c in columns]
        rows.append([*row, "chosen" if m.get("model") == chosen else ""])
    return Table(
        title="Models compared",
        meaning="Held-out poses were predicted without having been fitted: a model that only fits better is not "
        "better. Evidence weighs fit against the number of parameters.",
        columns=[*(MODEL_HEADINGS[c] for c in columns), ""],
        rows=rows,
        numeric=range(1, len(columns)),
    )


def models_by_rotation(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """rms residual of each model by rotation axis: fig. 8 (b) before and after the manipulator's own errors."""
    names = [key.removesuffix("_px") for key in rows[0] if key.endswith("_px")]
    rotations = [str(r["rotation"]).replace("-", "−") for r in rows]
    return Figure(
        title="Residuals by rotation, model by model",
        meaning="rms distance between detected and calculated centre for the poses of each rotation axis.",
        look_for="A model that explains the manipulator brings all bars to the height of those without rotation.",
        data=[
            {
                "type": "bar",
                "name": name,
                "x": rotations,
                "y": [row.get(f"{name}_px") for row in rows],
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


def _integrity(found: Mapping[str, Any]) -> list[Block]:
    blocks: list[Block] = []
    held, fit, chi2 = (found.get(k) for k in ("held_out_rms_px", "fit_rms_px", "held_out_chi2"))
    if held is not None and fit is not None:
        sentence = f"Poses left out of the fit are predicted to {number(held)} px rms; the fit leaves {number(fit)} px."
        if chi2 is not None:
            sentence += f" In units of the predicted uncertainty the square of the miss is {number(chi2)} (1 is right)."
        blocks.append(Words(title="Held-out poses", paragraphs=[sentence]))
    effects = found.get("effects") or ()
    if effects:
        blocks.append(
            Table(
                title="Did everything stand still?",
                meaning="Drift and steps, with the probability that chance alone makes one as large.",
                columns=["effect", "what it would be", "size / px", "probability by chance", "at pose"],
                rows=[
                    [
                        e.get("name", ""),
                        e.get("words", ""),
                        cell(e.get("size_px")),
                        probability(e.get("p")),
                        e.get("at") or "–",
                    ]
                    for e in effects
                ],
                numeric=(2, 3),
            )
        )
    repeats = found.get("repeats") or ()
    if repeats:
        columns = list(dict.fromkeys(key for row in repeats for key in row))
        blocks.append(
            Table(
                title="Poses taken twice",
                meaning="How far the ball's centre came back to where it had been.",
                columns=[heading(c) for c in columns],
                rows=[[cell(r.get(c)) for c in columns] for r in repeats],
                folded=len(repeats) > 12,
            )
        )
    return blocks


def probability(p: Any) -> str:
    if p is None or not np.isfinite(p):
        return "–"
    return "below 0.0001" if p < 1e-4 else f"{p:.4f}" if p < 0.1 else f"{p:.2f}"


def _noise_words(extra: Mapping[str, Any]) -> list[str]:
    words = []
    if extra.get("expected_residual_px") is not None:
        words.append(f"The stated uncertainties explain a residual of {number(extra['expected_residual_px'])} px.")
    if extra.get("widening") not in (None, 1, 1.0):
        words.append(
            f"All uncertainties were widened by the factor {number(np.sqrt(extra['widening']))}, since the residuals "
            "are larger than the stated noise."
        )
    noise = extra.get("pose_noise")
    if isinstance(noise, Mapping):
        words.append(
            f"Pose noise was found beside detection noise: {number(noise['translation_mm'] * 1e3)} µm and "
            f"{number(noise['rotation_rad'] * 1e6)} µrad; χ²/dof falls from {number(noise['chi2_dof_without'])} to "
            f"{number(noise['chi2_dof_with'])}."
        )
    return words


def _plain(key: str, value: Any) -> Table | None:
    """A result that has no place of its own."""
    rows = rows_of(value)
    if not rows:
        return None
    columns = list(dict.fromkeys(c for row in rows for c in row))
    return Table(
        title=heading(key).capitalize(),
        meaning="",
        columns=[heading(c) for c in columns],
        rows=[[cell(row.get(c)) for c in columns] for row in rows],
        folded=len(rows) > 20,
    )


def rows_of(value: Any) -> list[Mapping[str, Any]]:
    """A nested value as the rows of a table."""
    if isinstance(value, Mapping):
        if value and all(isinstance(v, Mapping) for v in value.values()):
            return [{"name": k, **v} for k, v in value.items()]
        return [{"name": heading(str(k)), "value": v} for k, v in value.items()]
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [v if isinstance(v, Mapping) else {"value": v} for v in value]
    return [{"value": value}]
