"""A review as the page sees it: numbers ready to be shown, and figures for the plotting script."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import takewhile
from typing import Any

import numpy as np

from tomopose.calibration.records.decisions import Decision
from tomopose.calibration.result import Calibration
from tomopose.observations import BallObservations
from tomopose.report.figures import coverage_figures, residual_figures, scene_figures
from tomopose.report.gather import join
from tomopose.report.page import Figure, figure_content
from tomopose.report.words import meaning, small_unit
from tomopose.review.session import Review, predicted_centres
from tomopose.units import Array, value_with_uncertainty


def residual_lengths(review: Review) -> tuple[Array, Array]:
    """(predicted (n, 2), distance (n,)), px, of every detection, those set aside too; NaN where there is none."""
    poses = review.poses
    where = {p: k for k, p in enumerate(poses.pose_id)}
    rows = [where.get(p, -1) for p in review.detected.pose_id]
    known = predicted_centres(review.calibration, poses)
    predicted = np.array([known[k] if k >= 0 else (np.nan, np.nan) for k in rows]).reshape(-1, 2)
    return predicted, np.linalg.norm(review.observations.x_D - predicted, axis=1)


def worst_first(review: Review) -> list[int]:
    """Rows without a measurement first, then by falling distance from where the calibration expects the ball."""
    _, d = residual_lengths(review)
    return [int(k) for k in np.argsort(-np.where(np.isfinite(d), d, np.inf), kind="stable")]


def rows_view(review: Review, which: Sequence[int] | None = None) -> list[dict[str, Any]]:
    """One mapping a detection; of all of them, or of some rows."""
    rows = range(len(review.detected)) if which is None else which
    return [{**one, **of_fit} for one, of_fit in zip(_detections(review, rows), _in_the_fit(review, rows), strict=True)]


def _detections(review: Review, which: Sequence[int]) -> list[dict[str, Any]]:
    """What of some rows no new solve changes: the detection, and the decision about it."""
    o, last = review.observations, {x.pose_id: x for x in review.decisions}
    some = np.asarray(which, dtype=np.int64)
    x_D, sigma = _shown(o.x_D[some]), _shown(np.linalg.norm(o.sigma[some], axis=1))
    out = []
    for k, x, s in zip(which, x_D, sigma, strict=True):
        decision = last.get(o.pose_id[k])
        out.append(
            {
                "pose": o.pose_id[k],
                "image": "" if o.image is None else o.image[k],
                "x": x,
                "sigma": s,
                "outline": _outline(o, k),
                "decision": None if decision is None else decision.action,
                "words": "" if decision is None else decision.words,
            }
        )
    return out


def _in_the_fit(review: Review, which: Sequence[int]) -> list[dict[str, Any]]:
    """What of some rows each solve changes."""
    o, cal = review.observations, review.calibration
    some = np.asarray(which, dtype=np.int64)
    predicted, d = residual_lengths(review)
    usual = float(np.median(cal.d)) if len(cal.pose_id) else float("nan")
    at, far = _shown(predicted[some]), _shown(d[some])
    times = _shown(d[some] / usual) if usual > 0 else [None] * len(some)
    used = set(cal.pose_id)
    return [
        {
            "used": o.pose_id[k] in used,
            "status": cal.outliers.get(o.pose_id[k]) or (o.status[k] if o.status is not None else ""),
            "predicted": p,
            "d": f,
            "times": t,
        }
        for k, p, f, t in zip(which, at, far, times, strict=True)
    ]


DIGITS = 7
"""Of a number on the page: a ten-thousandth of a pixel, on any panel."""


def _shown(values: Array) -> list[Any]:
    """Numbers (n,) or (n, 2) as the page takes them, rounded to DIGITS digits; None where one is not finite."""
    rounded = [None if not math.isfinite(x) else float(f"{x:.{DIGITS}g}") for x in values.ravel().tolist()]
    return rounded if values.ndim == 1 else [rounded[k : k + 2] for k in range(0, len(rounded), 2)]


def _outline(o: BallObservations, k: int) -> list[float] | None:
    """Centre, semi axes and angle of the silhouette; None where none was found."""
    if o.x_ellipse is None or o.semi_major is None or o.semi_minor is None:
        return None
    angle = 0.0 if o.angle is None or not np.isfinite(o.angle[k]) else float(o.angle[k])
    values = [*map(float, o.x_ellipse[k]), float(o.semi_major[k]), float(o.semi_minor[k]), angle]
    return values if all(map(math.isfinite, values)) else None


def result_view(calibration: Calibration) -> dict[str, Any]:
    """Verdict, findings and parameters."""
    return {
        "verdict": calibration.verdict,
        "status": calibration.status,
        "reasons": calibration.reasons,
        "findings": [
            {"rule": f.rule, "words": f.words, "fix": f.remedy, "verdict": f.verdict} for f in calibration.checks
        ],
        "d_rms": calibration.d_rms if calibration.pose_id else None,
        "d_rms_um": calibration.d_rms_um if calibration.pose_id else None,
        "chi2_dof": calibration.chi2_dof,
        "used": len(calibration.pose_id),
        "aside": len(calibration.outliers) + len(calibration.not_seen),
        "parameters": [
            {
                "name": p.name,
                "meaning": meaning(p.name),
                "value": value_with_uncertainty(p.value, p.u, p.unit),
                "u": small_unit(p.u, p.unit),
            }
            for p in calibration.parameters
        ],
    }


def state_view(review: Review) -> dict[str, Any]:
    """What changes with a decision, without the figures."""
    return {
        "rows": rows_view(review),
        "result": result_view(review.calibration),
        "decisions": decisions_view(review.decisions),
    }


def decisions_view(decisions: Sequence[Decision]) -> list[dict[str, str]]:
    """Decisions as the page lists them, oldest first."""
    return [{"pose": d.pose_id, "words": d.words, "when": d.when, "action": d.action} for d in decisions]


def changes_view(before: Review, after: Review) -> dict[str, Any]:
    """What the page of `before` must change to show `after`.

    rows: by their number, what of them differs: of a decision that left the calibration as it is, one whole row, and
    where it was solved again, what follows from the fit of the others too;  result: where it was solved again;  keep:
    how many of the decisions stay, oldest first, and decisions: those that follow.
    """
    keep = sum(1 for _ in takewhile(lambda p: p[0] is p[1], zip(before.decisions, after.decisions, strict=False)))
    solved = after.calibration is not before.calibration
    poses = {d.pose_id for d in (*before.decisions[keep:], *after.decisions[keep:])}
    decided = [k for k, pose in enumerate(after.detected.pose_id) if pose in poses]
    more = {"result": result_view(after.calibration)} if solved else {}
    refitted = range(len(after.detected)) if solved else decided
    rows = {str(k): row for k, row in zip(refitted, _in_the_fit(after, refitted), strict=True)}
    for k, row in zip(decided, _detections(after, decided), strict=True):
        rows[str(k)] |= row
    return {"rows": rows, "keep": keep, "decisions": decisions_view(after.decisions[keep:]), **more}


def figures_view(review: Review) -> list[dict[str, Any]]:
    """The residual plots and the scene of the calibration as it is now; empty where nothing was fitted."""
    cal = review.calibration
    if not cal.pose_id:
        return []
    joined = join(cal, observations=review.observations, poses=review.poses)
    figures: list[tuple[str, Figure | None]] = [
        ("By pose", residual_figures.by_pose(joined)),
        ("On the detector", residual_figures.quiver(cal, joined)),
        ("By axis", residual_figures.by_coordinate(joined)),
        ("Over time", residual_figures.over_sequence(joined)),
        ("Panel", coverage_figures.detector_map(cal, joined, review.observations)),
        ("Scene", scene_figures.scanner_scene(cal, joined)),
        ("Ball", scene_figures.ball_scene(cal, joined)),
    ]
    return [_tab(name, figure) for name, figure in figures if figure is not None]


def _tab(name: str, figure: Figure) -> dict[str, Any]:
    words = {"tab": name, "title": figure.title, "meaning": figure.meaning, "look_for": figure.look_for}
    return {**words, "height": figure.height, "solid": figure.solid, **figure_content(figure)}
