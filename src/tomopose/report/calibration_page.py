"""The report of a calibration: verdict first, then what was found, how well the data fit, and what they can tell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tomopose.calibration.result import Calibration, Parameter
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations
from tomopose.report import coverage_figures, residual_figures, scene_figures
from tomopose.report.checks_section import checks_section
from tomopose.report.gather import Joined, join
from tomopose.report.history_page import history_section
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
from tomopose.report.provenance_section import provenance_section
from tomopose.report.thumbnails import Thumbnail
from tomopose.report.words import (
    NOT_DETERMINABLE,
    NOT_GIVEN,
    cell,
    decimals,
    heading,
    meaning,
    number,
    small_unit,
    with_unit,
)
from tomopose.units import value_with_uncertainty

TONES: Mapping[str, Any] = {"trustworthy": GOOD, "doubtful": CARE, "rejected": BAD}
COVERAGE_FACTOR = 2.0
HYPOTHESIS_COLUMNS = ("words", "verdict", "d_rms_px", "delta_chi2", "cure")
NO_DOUBT: Mapping[str, tuple[str, ...]] = {
    "trustworthy": ("none of the checks gave a reason for doubt",),
    "doubtful": (),
    "rejected": (),
}
MANY_PARAMETERS = 12
MACHINE_LISTS = ("names", "values", "units", "u", "nominal")
"""Parts of `Calibration.manipulator` that stand in the tables of parameters already, or in its input file."""


def calibration_report(
    calibration: Calibration,
    *,
    observations: BallObservations | None,
    poses: PoseSequence | None,
    thumbnails: Sequence[Thumbnail] = (),
    scan: ProjectionMatrices | None = None,
    history: Sequence[Mapping[str, Any]] = (),
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

    Returns
    -------
    HTML text; it loads nothing from a network.  Parts that were not given are named as such.
    """
    n, left = len(calibration.pose_id), len(set_aside(calibration))
    sections = [
        _parameters(calibration),
        *_data_sections(calibration, observations=observations, poses=poses, thumbnails=thumbnails, scan=scan),
        *(section for section in (checks_section(calibration), history_section(history)) if section is not None),
        provenance_section(calibration.provenance),
    ]
    page = Page(
        title=title,
        subtitle=f"{n} radiographs used, {left} set aside · model {calibration.model} · magnification "
        f"{calibration.scanner.magnification:.3f} · pose convention {calibration.convention}",
        verdict=_verdict(calibration),
        key_figures=_key_figures(calibration, scan),
        sections=sections,
        footer="Written by tomopose. Uncertainties are standard uncertainties unless k = 2 is said. Equation and "
        "figure numbers are those of Butzhammer, Müller and Hausotte, Meas. Sci. Technol. 34 (2023) 015403.",
    )
    return render(page)


def _data_sections(
    calibration: Calibration, *, observations: BallObservations | None, poses: PoseSequence | None,
    thumbnails: Sequence[Thumbnail], scan: ProjectionMatrices | None,
) -> list[Section]:
    """What rests on residuals; a calibration that failed before it had any says so."""
    if not calibration.pose_id:
        words = "The calibration holds no residuals: it ended before poses were fitted."
        return [Section(title="How well the data fit", blocks=[Words(paragraphs=[words])])]
    joined = join(calibration, observations=observations, poses=poses)
    return [
        _residuals(calibration, joined),
        _detections(calibration, joined, observations, thumbnails),
        _observability(calibration),
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
    keys = [
        KeyFigure(name="Reprojection error d_rms", value=with_unit(d_px, "px"), note="eq. (8)"),
        KeyFigure(name="… at the object", value=with_unit(d_um, "µm"), note="pitch over magnification"),
        KeyFigure(
            name="χ² per degree of freedom",
            value=number(chi2) if np.isfinite(chi2) else NOT_DETERMINABLE,
            note=f"{calibration.dof} degrees; 1 where noise is all",
        ),
        KeyFigure(
            name="Condition number",
            value=number(calibration.observability.condition),
            note=f"{len(calibration.observability.unobservable)} directions unobservable",
        ),
    ]
    if scan is None or scan.points_sigma is None:
        keys.append(KeyFigure(name="Expected effect on the scan", value=NOT_GIVEN, note="no scan given"))
    else:
        sigma = float(np.sqrt(np.nanmean(np.asarray(scan.points_sigma) ** 2)))
        pitch = np.sqrt(scan.p_u * scan.p_v) * 1000.0 / calibration.scanner.magnification
        keys.append(
            KeyFigure(
                name="Expected effect on the scan", value=f"{number(sigma)} px",
                note=f"{number(sigma * pitch)} µm at the object, rms",
            )
        )
    return keys


def _parameters(calibration: Calibration) -> Section:
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
                errors, title="Identified errors of the manipulator",
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
    return Section(title="What was found", lead="How the manipulator sits on the table, and where the ball is.",
                   blocks=blocks)


def _parameter_table(parameters: Sequence[Parameter], *, title: str, words: str) -> Table:
    rows = []
    for p in parameters:
        degrees = f"{np.degrees(p.value):.6f}°" if p.unit == "rad" else ""
        rows.append(
            [p.name, meaning(p.name), value_with_uncertainty(p.value, p.u, p.unit), degrees, small_unit(p.u, p.unit),
             small_unit(COVERAGE_FACTOR * p.u, p.unit)]
        )
    return Table(
        title=title, meaning=words, columns=["parameter", "what it is", "value", "in degrees", "u", "U (k = 2)"],
        rows=rows, numeric=(2, 3, 4, 5), folded=len(rows) > 2 * MANY_PARAMETERS,
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
        "small residual alone proves little: see what the poses can tell.",
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
                meaning="Images that do not take part in the result, and why.",
                columns=["pose", "reason"],
                rows=[[p, reason] for p, reason in aside.items()],
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
    not_seen = calibration.extra.get("not_seen")
    return {**(not_seen if isinstance(not_seen, Mapping) else {}), **calibration.outliers}


def _pose_table(joined: Joined, observations: BallObservations | None) -> Table:
    snr: dict[str, float] = {}
    if observations is not None and observations.snr is not None:
        snr = dict(zip(observations.pose_id, map(float, observations.snr), strict=True))
    rows = []
    k_px = decimals(joined.d)
    for k in np.argsort(-joined.d, kind="stable"):
        pose = joined.pose_id[k]
        rows.append(
            [pose, joined.group[k] if joined.group else "–", f"{joined.x_D[k, 0]:.4f}", f"{joined.x_D[k, 1]:.4f}",
             f"{joined.r[k, 0]:+.{k_px}f}", f"{joined.r[k, 1]:+.{k_px}f}", f"{joined.d[k]:.{k_px}f}",
             f"{np.linalg.norm(joined.z[k]):.2f}", number(snr[pose]) if np.isfinite(snr.get(pose, np.nan)) else "–"]
        )
    return Table(
        title="All poses used, worst first",
        meaning="A click on a column's head sorts by it.",
        columns=[
            "pose", "rotation", "u / px", "v / px", "residual u / px", "residual v / px", "d / px", "d / σ", "SNR",
        ],
        rows=rows,
        numeric=range(2, 9),
        folded=True,
    )


def _observability(calibration: Calibration) -> Section:
    seen = calibration.observability
    blocks: list[Block] = []
    if seen.unobservable:
        blocks.append(Words(title="Directions that these poses cannot tell", items=seen.unobservable, wide=False))
        lead = "Some directions of the parameters are not held by these poses."
    else:
        blocks.append(
            Words(title="Directions that these poses cannot tell", paragraphs=["None among the parameters solved for."],
                  wide=False)
        )
        lead = "All parameters solved for are held by these poses."
    if seen.notes:
        blocks.append(Words(title="What is taken as known, and what would help", items=seen.notes, wide=False))
    else:
        blocks.append(Words(title="What would help", paragraphs=["Nothing was proposed."], wide=False))
    alike = sum(1 for row in calibration.hypotheses if str(row.get("verdict", "")).startswith("cannot be told apart"))
    if alike:
        lead += f" Rival conventions that they cannot tell from the declared one: {alike}, see below."
    blocks += [coverage_figures.correlation_map(calibration), coverage_figures.singular_values(calibration)]
    blocks += _hypotheses(calibration.hypotheses)
    return Section(title="What the poses can tell", lead=lead, blocks=blocks)


def _hypotheses(hypotheses: Sequence[Mapping[str, Any]]) -> list[Block]:
    """Rivals that are still possible, open to view; those that the data exclude, folded away."""
    if not hypotheses:
        return [Words(title="Rival conventions", paragraphs=[f"Hypotheses tried: {NOT_GIVEN}."])]
    present = {key for row in hypotheses for key in row}
    columns = [c for c in HYPOTHESIS_COLUMNS if c in present] or sorted(present)
    excluded = [row for row in hypotheses if row.get("verdict") == "excluded"]
    possible = [row for row in hypotheses if row.get("verdict") != "excluded"]
    tables = []
    for title, rows, words in (
        (
            "Rival conventions",
            possible,
            "Other readings of the same data (orders, signs, flips, pairing), fitted the same way. One that fits about "
            "as well cannot be told apart with these poses, and one of the two ruins the scan.",
        ),
        ("Rival conventions that the data exclude", excluded, "They fit significantly worse."),
    ):
        if rows:
            tables.append(
                Table(
                    title=title, meaning=words, columns=[heading(c) for c in columns],
                    rows=[[_hypothesis_cell(c, row.get(c)) for c in columns] for row in rows],
                    folded=rows is excluded,
                )
            )
    return list(tables)


def _hypothesis_cell(column: str, value: Any) -> str:
    """Differences of chi2 need no more than a decimal: what is below one is nothing."""
    if column == "delta_chi2" and value is not None and abs(value) < 1e4:
        return f"{value:.1f}".replace("-0.0", "0.0")
    return cell(value)


def _coverage(calibration: Calibration, joined: Joined, observations: BallObservations | None) -> Section:
    blocks: list[Block | None] = [
        coverage_figures.detector_map(calibration, joined, observations),
        coverage_figures.table_angles(joined),
        coverage_figures.rotation_map(joined),
    ]
    if joined.poses is None:
        blocks.append(Words(paragraphs=[f"Rotations and table angles: {NOT_GIVEN} (no pose table)."], wide=False))
    return Section(title="Coverage", lead="Where in the machine the model was tested.",
                   blocks=[b for b in blocks if b is not None])


def _scene(calibration: Calibration, joined: Joined, scan: ProjectionMatrices | None) -> Section:
    blocks: list[Block | None] = [
        scene_figures.scanner_scene(calibration, joined), scene_figures.ball_scene(calibration, joined)
    ]
    if scan is None:
        words = f"Path of the source and expected effect: {NOT_GIVEN} (no scan)."
        blocks.append(Words(title="Scan", paragraphs=[words], wide=False))
    else:
        blocks += [scene_figures.source_path(scan), coverage_figures.scan_effect(scan)]
        if scan.points_sigma is None:
            blocks.append(Words(paragraphs=[f"Expected effect on the scan: {NOT_DETERMINABLE}, the matrices hold no "
                                            "uncertainty."]))
    return Section(title="In space", lead="The geometry as calibrated; drag to turn, scroll to come nearer.",
                   blocks=[b for b in blocks if b is not None])
