"""Figure 8: the reprojection error pose by pose, for a perfect manipulator (a) and for one that errs (b)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from tomopose.calibration.solve import calibrate
from tomopose.manipulator.poses import PoseSequence
from tomopose.report.gather import rotation_groups
from tomopose.report.page import Figure
from tomopose.report.style import NO_ROTATION, ROTATION_COLOURS, axis, layout
from tomopose.studies.parts.hexapod_runs import solve_run
from tomopose.studies.parts.radiographs import measure_run, solve_as_paper
from tomopose.studies.parts.result import Progress, Scale, StudyCheck, StudyRow, check_below, check_between
from tomopose.studies.parts.steps import Steps
from tomopose.studies.parts.virtual_hexapod import ball_run as hexapod_run
from tomopose.studies.section6.calibrations import projected, rigid
from tomopose.studies.table1 import PRINTED, ball_run
from tomopose.units import Array

# Sec. 5.2 on fig. 8 (b): rms of d_k without rotation, about x and about z, px.
PRINTED_RMS = {NO_ROTATION: 0.031, "x": 0.069, "z": 0.144}
# Sec. 5.2: poses turned about y show values above 0.8 px.
PRINTED_ABOVE_Y = 0.8
MAGNIFICATION = 5.3

TITLE = "Figure 8: reprojection error pose by pose"
QUESTION = "Which poses carry the residuals of a real calibration, and are they gone once the errors are identified?"
NOTES = (
    "The small scale takes 2 x 2 x 2 x 7 poses; the printed numbers are those of 3 x 3 x 3 x 7.",
    "(a) is the run of table 1, (b) run 1 of table 2's virtual hexapod at M 5.3. Three printed numbers are fitted by "
    "the choice of its scatter, its axes' angles and its lever: those without rotation, about y and about z. The one "
    "about x is not fitted, and the repeat with the table at 90 degrees (c) is predicted: the paper prints no number "
    "for it, but says that the diagram was similar with high values for rotations about x. That this form of error is "
    "the only one that does so is not shown.",
    "(c) takes projected centres with the paper's detection error, and no radiographs.",
    "The paper prints no rms for turns about y, only that values lie above 0.8 px.",
    "Rotations about x stay below the printed 0.069 px: the virtual hexapod has no error that moves the ball sideways "
    "there.",
)


def rms_by_axis(d: Array, poses: PoseSequence) -> dict[str, float]:
    """rms of d_k (n,), px, of poses without rotation and of those about x, y, z."""
    groups = np.array([g.lstrip("+−") for g in rotation_groups(poses)])
    return {g: float(np.sqrt(np.mean(np.asarray(d)[groups == g] ** 2))) for g in (NO_ROTATION, "x", "y", "z")}


def by_pose(title: str, meaning: str, look_for: str, d: Array, poses: PoseSequence) -> Figure:
    """d_k over the pose's number, coloured by the axis and sign of its rotation."""
    groups = np.array(rotation_groups(poses))
    data = []
    for name, colour in ROTATION_COLOURS.items():
        k = np.flatnonzero(groups == name)
        if k.size:
            data.append(
                {
                    "type": "scatter",
                    "mode": "markers",
                    "name": f"rotation {name}",
                    "x": k + 1,
                    "y": d[k],
                    "marker": {"size": 7, "color": colour},
                }
            )
    return Figure(
        title=title,
        meaning=meaning,
        look_for=look_for,
        data=data,
        layout=layout(xaxis=axis("pose"), yaxis=axis("d_k / px", rangemode="tozero")),
    )


def repeat_at_90(n: int, seed: int) -> dict[str, float]:
    """rms of d_k by axis, px, of the paper's repeat: the same poses, mount and errors, the table at 90 degrees."""
    run = hexapod_run(MAGNIFICATION, n, seed, number=1)
    turned = replace(run, poses=replace(run.poses, alpha=np.full(len(run.poses), np.pi / 2)))
    rng = np.random.default_rng(np.random.SeedSequence([seed, 90, n]))
    return rms_by_axis(rigid(turned, projected(turned, rng)).d, run.poses)


def checks_of(
    a: dict[str, float], b: dict[str, float], best: dict[str, float], floor: float, c: dict[str, float]
) -> list[StudyCheck]:
    """Homogeneous in (a), y far above the rest in (b), x in (c), and homogeneous again by our best."""
    return [
        check_between(
            "(b) by the paper's method rotations about x are within a factor of 2 of the printed 0.069 px, which is "
            "not fitted",
            b["x"],
            PRINTED_RMS["x"] / 2,
            2 * PRINTED_RMS["x"],
            "px",
        ),
        check_between(
            "(c) predicted, as the paper found at a table angle of 90 degrees: rotations about x carry the residuals, "
            "as large as those about y at 0 (ratio)",
            c["x"] / b["y"],
            0.8,
            1.25,
            "",
        ),
        check_below(
            "(c) predicted: rotations about y are then as small as the others were (over those about x)",
            c["y"] / c["x"],
            0.25,
            "",
        ),
        check_below(
            "(a) by the paper's method no rotation is prominent (largest over smallest rms)",
            max(a.values()) / min(a.values()),
            1.5,
            "x",
        ),
        check_between(
            "(b) by the paper's method rotations about y carry the residuals, above 0.8 px", b["y"], 0.8, 1.0, "px"
        ),
        check_between(
            "(b) by the paper's method poses without rotation are as printed, 0.031 px",
            b[NO_ROTATION],
            0.02,
            0.045,
            "px",
        ),
        check_between("(b) by the paper's method rotations about z are as printed, 0.144 px", b["z"], 0.11, 0.18, "px"),
        check_below("(b) by our best no rotation is above 1.5 x the floor", max(best.values()) / floor, 1.5, "x"),
    ]


def run(scale: Scale, seed: int, steps: Steps, progress: Progress) -> tuple[Any, Any, Any, Any]:
    """Rows, checks, figures and notes."""
    n = 3 if scale == "paper" else 2
    images = 7 * n**3
    perfect = ball_run(MAGNIFICATION, n, seed)
    measured = measure_run(perfect, steps, f"centres-perfect-{n}", lambda done, _: progress(done, 2 * images))
    a, _ = solve_as_paper(perfect, measured)
    a_best = calibrate(perfect.scanner, perfect.poses, measured.best, hypotheses=False)
    b = solve_run(MAGNIFICATION, n, seed, 1, steps, lambda done, _: progress(images + done, 2 * images))
    poses = perfect.poses
    used = poses.select(poses.index_of(b.best.pose_id))
    by_axis = {
        "a": rms_by_axis(a.d, poses),
        "a best": rms_by_axis(a_best.d, poses.select(poses.index_of(a_best.pose_id))),
        "b": rms_by_axis(b.paper_method.d, poses),
        "b best": rms_by_axis(b.best.d, used),
        "c": repeat_at_90(n, seed),
    }
    rows = [
        StudyRow(
            group="(a) perfect manipulator",
            quantity="d_rms_opt",
            unit="px",
            source=f"table 1, row {list(PRINTED).index((MAGNIFICATION, n)) + 1}",
            printed=PRINTED[MAGNIFICATION, n][0],
            paper_method=a.d_rms,
            best=a_best.d_rms,
        )
    ]
    for letter, group in (("a", "(a) perfect manipulator"), ("b", "(b) manipulator that errs")):
        for name, value in by_axis[letter].items():
            printed = PRINTED_RMS.get(name) if letter == "b" else None
            rows.append(
                StudyRow(
                    group=group,
                    quantity=f"rms of d_k, rotation {name}",
                    unit="px",
                    printed=printed,
                    source="sec. 5.2" if printed or (letter, name) == ("b", "y") else "",
                    paper_method=value,
                    best=by_axis[f"{letter} best"][name],
                    note="printed: values above 0.8" if (letter, name) == ("b", "y") else "",
                )
            )
    rows += [
        StudyRow(
            group="(c) predicted: the repeat at a table angle of 90 degrees",
            quantity=f"rms of d_k, rotation {name}",
            unit="px",
            source="sec. 5.2" if name == "x" else "",
            paper_method=value,
            note="printed: similar to (b), high values about x" if name == "x" else "",
        )
        for name, value in by_axis["c"].items()
    ]
    figures = (
        by_pose(
            "Fig. 8 (a): perfect manipulator",
            "d_k by the paper's method from simulated radiographs.",
            "No colour is prominent: only the detection's own error is left.",
            a.d,
            poses,
        ),
        by_pose(
            "Fig. 8 (b): manipulator that errs",
            "d_k by the paper's method, the virtual hexapod.",
            "Rotations about y are far above the rest.",
            b.paper_method.d,
            poses,
        ),
        by_pose(
            "Fig. 8 (b) with the errors identified",
            "d_k by our best, the same radiographs.",
            "The pattern is gone; what is left is the plate's scatter. Note the axis.",
            b.best.d,
            used,
        ),
    )
    return rows, checks_of(by_axis["a"], by_axis["b"], by_axis["b best"], b.floor, by_axis["c"]), figures, NOTES
