"""The report of a calibration: verdict first, then what was found, how well the data fit, and what they determine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import islice
from typing import Any

import numpy as np

from tomopose.calibration.records.decisions import Decision
from tomopose.calibration.result import Calibration
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations
from tomopose.report.figures import coverage_figures, residual_figures, scene_figures
from tomopose.report.figures.thumbnails import Thumbnail
from tomopose.report.gather import MOST_LISTED, Joined, join, listed_words
from tomopose.report.page import (
    BAD,
    CARE,
    GOOD,
    Block,
    KeyFigure,
    Page,
    Pictures,
    Section,
    Table,
    Verdict,
    Words,
    render,
)
from tomopose.report.pages.history_page import history_section
from tomopose.report.sections.answers import answers, condition_words, fit_words
from tomopose.report.sections.checks import checks_section, findings_table
from tomopose.report.sections.observability import observability_section
from tomopose.report.sections.parameters import parameters_section
from tomopose.report.sections.provenance import provenance_section
from tomopose.report.words import (
    NOT_DETERMINABLE,
    NOT_GIVEN,
    decimals,
    number,
    with_unit,
)

TONES: Mapping[str, Any] = {"trustworthy": GOOD, "doubtful": CARE, "rejected": BAD}
NO_DOUBT: Mapping[str, tuple[str, ...]] = {
    "trustworthy": ("none of the checks gave a reason for doubt",),
    "doubtful": (),
    "rejected": (),
}


def calibration_report(
    calibration: Calibration,
    *,
    observations: BallObservations | None,
    poses: PoseSequence | None,
    thumbnails: Sequence[Thumbnail] = (),
    scan: ProjectionMatrices | None = None,
    history: Sequence[Mapping[str, object]] = (),
    decisions: Sequence[Decision] = (),
    title: str = "Calibration report",
) -> str:
    """One offline HTML document about a calibration.

    Parameters
    ----------
    calibration:  what is reported.
    observations: all detections, those set aside too; gives normalised residuals their predicted uncertainty.
    poses:        the pose table; without it the report knows no rotations, angles and scenes of poses.
    thumbnails:   pictures of the worst detections, worst first (`worst_thumbnails` makes them).
    scan:         matrices of a scan made with this calibration: adds the source's path and the expected effect.
    history:      entries of the machine's history file, oldest first: adds control charts where there are three.
    decisions:    of a person about the detections, oldest first: all of them are listed.

    Returns
    -------
    HTML text; it loads nothing from a network.  Parts that were not given are named as such.
    """
    n, left = len(calibration.pose_id), len(set_aside(calibration))
    sections = [
        *findings_table(calibration),
        parameters_section(calibration),
        *decisions_section(decisions),
        *_data_sections(calibration, observations=observations, poses=poses, thumbnails=thumbnails, scan=scan),
        *(section for section in (checks_section(calibration), history_section(history)) if section is not None),
        provenance_section(calibration.provenance),
    ]
    page = Page(
        title=title,
        subtitle=f"{n} radiographs used, {left} set aside · model {calibration.model} · magnification "
        f"{calibration.scanner.magnification:.3f} · pose convention {calibration.convention}",
        verdict=_verdict(calibration),
        answers=answers(calibration),
        key_figures=_key_figures(calibration, scan),
        sections=sections,
        footer="Written by tomopose. Uncertainties are standard uncertainties unless k = 2 is said. Equation and "
        "figure numbers are those of Butzhammer, Müller and Hausotte, Meas. Sci. Technol. 34 (2023) 015403.",
    )
    return render(page)


def decisions_section(decisions: Sequence[Decision]) -> list[Section]:
    """Every decision that a person took about the detections; nothing where there was none."""
    if not decisions:
        return []
    done = {"accept": "accepted", "leave-out": "left out", "measure-again": "measured again"}
    table = Table(
        title="Decisions",
        meaning="The last decision about a pose counts.",
        columns=["pose", "decision", "who", "when (UTC)", "why"],
        rows=[[d.pose_id, done[d.action], d.who, d.when, d.why or "–"] for d in decisions],
    )
    lead = "What a person decided about the detections (decisions.jsonl); the result above follows from it."
    return [Section(title="Manual decisions", lead=lead, blocks=[table])]


def _data_sections(
    calibration: Calibration,
    *,
    observations: BallObservations | None,
    poses: PoseSequence | None,
    thumbnails: Sequence[Thumbnail],
    scan: ProjectionMatrices | None,
) -> list[Section]:
    """What rests on residuals; a calibration that failed before it had any says so."""
    if not calibration.pose_id:
        words = "The calibration holds no residuals: it ended before poses were fitted."
        return [Section(title="How well the data fit", blocks=[Words(paragraphs=[words])])]
    joined = join(calibration, observations=observations, poses=poses)
    return [
        _residuals(calibration, joined),
        _detections(calibration, joined, observations, thumbnails),
        observability_section(calibration),
        _coverage(calibration, joined, observations),
        _scene(calibration, joined, scan),
    ]


def _verdict(calibration: Calibration) -> Verdict:
    sentence = calibration.status or "The solver gave no sentence about how it ended."
    if not calibration.converged:
        sentence = "Not converged: " + sentence
    return Verdict(
        word=calibration.verdict.capitalize(),
        sentence=sentence,
        tone=TONES[calibration.verdict],
        reasons=calibration.reasons or NO_DOUBT[calibration.verdict],
    )


def _key_figures(calibration: Calibration, scan: ProjectionMatrices | None) -> list[KeyFigure]:
    chi2 = calibration.chi2_dof
    d_px, d_um = (calibration.d_rms, calibration.d_rms_um) if calibration.pose_id else (np.nan, np.nan)
    seen = calibration.observability
    keys = [
        KeyFigure(
            name="Reprojection error d_rms",
            value=with_unit(d_px, "px"),
            note="Distance of detected from calculated centres, eq. (8): small is necessary, not sufficient.",
        ),
        KeyFigure(
            name="… at the object",
            value=with_unit(d_um, "µm"),
            note="The same at the ball: pitch over the magnification there.",
        ),
        KeyFigure(
            name="χ² per degree of freedom",
            value=number(chi2) if np.isfinite(chi2) else NOT_DETERMINABLE,
            note=fit_words(chi2, calibration.dof),
        ),
        KeyFigure(
            name="Condition number",
            value=number(seen.condition),
            note=condition_words(seen.condition, len(seen.unobservable)),
        ),
    ]
    if scan is None or scan.points_sigma is None:
        keys.append(KeyFigure(name="Expected effect on the scan", value=NOT_GIVEN, note="No scan was given (--scan)."))
    else:
        sigma = float(np.sqrt(np.nanmean(np.asarray(scan.points_sigma) ** 2)))
        pitch = np.sqrt(scan.p_u * scan.p_v) * 1000.0 / calibration.scanner.magnification
        keys.append(
            KeyFigure(
                name="Expected effect on the scan",
                value=f"{number(sigma)} px",
                note=f"{number(sigma * pitch)} µm at the object, root mean square; well below half a pixel is good.",
            )
        )
    return keys


def _residuals(calibration: Calibration, joined: Joined) -> Section:
    blocks: list[Block | None] = [
        residual_figures.by_pose(joined),
        residual_figures.quiver(calibration, joined),
        residual_figures.rotation_table(calibration, joined),
        residual_figures.over_sequence(joined),
        residual_figures.by_coordinate(joined),
        residual_figures.histogram(joined),
        residual_figures.quantiles(joined),
    ]
    if joined.poses is None:
        blocks.append(Words(paragraphs=[f"Residuals by rotation and by coordinate: {NOT_GIVEN} (no pose table)."]))
    return Section(
        title="How well the data fit",
        lead=f"Reprojection error {number(calibration.d_rms)} px, {number(calibration.d_rms_um)} µm at the object. A "
        "small residual alone proves little: see what the poses determine.",
        blocks=[b for b in blocks if b is not None],
    )


def _detections(
    calibration: Calibration, joined: Joined, observations: BallObservations | None, thumbnails: Sequence[Thumbnail]
) -> Section:
    blocks: list[Block] = []
    aside = set_aside(calibration)
    if aside:
        blocks.append(
            Table(
                title="Set aside",
                meaning="Images that do not take part in the result, and why."
                + listed_words(len(aside), "the first", "calibration.json"),
                columns=["pose", "reason"],
                rows=[[p, reason] for p, reason in islice(aside.items(), MOST_LISTED)],
                wide=len(aside) > 8,
            )
        )
    else:
        blocks.append(Words(title="Set aside", paragraphs=["No image was set aside as an outlier."]))
    if thumbnails:
        blocks.append(
            Pictures(
                title="Worst detections",
                meaning="Crops of the radiographs, worst first, with the silhouette that was found (orange) and the "
                "projection of the ball's centre (blue).",
                look_for="The line should follow the ball's rim all round; where it does not, the image or the "
                "detection is at fault, not the machine.",
                thumbnails=thumbnails,
            )
        )
    else:
        blocks.append(Words(title="Worst detections", paragraphs=[f"Radiographs: {NOT_GIVEN}, so no pictures."]))
    blocks.append(_pose_table(joined, observations))
    return Section(title="Detections", lead="The images behind the numbers.", blocks=blocks)


def set_aside(calibration: Calibration) -> dict[str, str]:
    """Poses that do not take part, with the reason: no ball measured, or an outlier of the fit."""
    return {**calibration.not_seen, **calibration.outliers}


def _pose_table(joined: Joined, observations: BallObservations | None) -> Table:
    snr: dict[str, float] = {}
    if observations is not None and observations.snr is not None:
        snr = dict(zip(observations.pose_id, map(float, observations.snr), strict=True))
    rows = []
    k_px = decimals(joined.d)
    for k in np.argsort(-joined.d, kind="stable")[:MOST_LISTED]:
        pose = joined.pose_id[k]
        rows.append(
            [
                pose,
                joined.group[k] if joined.group else "–",
                f"{joined.x_D[k, 0]:.4f}",
                f"{joined.x_D[k, 1]:.4f}",
                f"{joined.r[k, 0]:+.{k_px}f}",
                f"{joined.r[k, 1]:+.{k_px}f}",
                f"{joined.d[k]:.{k_px}f}",
                f"{np.linalg.norm(joined.z[k]):.2f}",
                number(snr[pose]) if np.isfinite(snr.get(pose, np.nan)) else "–",
            ]
        )
    return Table(
        title=f"{'All' if len(rows) == len(joined.d) else 'The worst'} poses used, worst first",
        meaning="A click on a column's head sorts by it."
        + listed_words(len(joined.d), "the worst", "calibration.json (residuals)"),
        columns=[
            "pose",
            "rotation",
            "u / px",
            "v / px",
            "residual u / px",
            "residual v / px",
            "d / px",
            "d / σ",
            "SNR",
        ],
        rows=rows,
        numeric=range(2, 9),
        folded=True,
    )


def _coverage(calibration: Calibration, joined: Joined, observations: BallObservations | None) -> Section:
    blocks: list[Block | None] = [
        coverage_figures.detector_map(calibration, joined, observations),
        coverage_figures.table_angles(joined),
        coverage_figures.rotation_map(joined),
    ]
    if joined.poses is None:
        blocks.append(Words(paragraphs=[f"Rotations and table angles: {NOT_GIVEN} (no pose table)."], wide=False))
    return Section(
        title="Coverage", lead="Where in the machine the model was tested.", blocks=[b for b in blocks if b is not None]
    )


def _scene(calibration: Calibration, joined: Joined, scan: ProjectionMatrices | None) -> Section:
    blocks: list[Block | None] = [
        scene_figures.scanner_scene(calibration, joined),
        scene_figures.ball_scene(calibration, joined),
    ]
    if scan is None:
        words = f"Path of the source and expected effect: {NOT_GIVEN} (no scan)."
        blocks.append(Words(title="Scan", paragraphs=[words], wide=False))
    else:
        blocks += [scene_figures.source_path(scan), coverage_figures.scan_effect(scan)]
        if scan.points_sigma is None:
            blocks.append(
                Words(
                    paragraphs=[f"Expected effect on the scan: {NOT_DETERMINABLE}, the matrices hold no uncertainty."]
                )
            )
    return Section(
        title="In space",
        lead="The geometry as calibrated; drag to turn, scroll to come nearer.",
        blocks=[b for b in blocks if b is not None],
    )
