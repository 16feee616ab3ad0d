"""The steps that verbs share: tables and radiographs to observations, and a result to its folder."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from tomopose.cli.common import NOT_TRUSTWORTHY, OK, Say

RAW = re.compile(r"(?P<n_v>\d+)x(?P<n_u>\d+):(?P<dtype>[^:]+)(:(?P<header>\d+))?")

if TYPE_CHECKING:
    from tomopose import BallObservations, Calibration, PoseSequence, ProjectionMatrices, Scanner
    from tomopose.calibration.checks.verdict import Finding
    from tomopose.calibration.model.assumed import Assumed
    from tomopose.calibration.records.decisions import Decision
    from tomopose.io.images.sequence import ImageSequence
    from tomopose.manipulator.real_poses import ErrorModel
    from tomopose.report.figures.thumbnails import Thumbnail


def image_source(text: str) -> str | Path:
    """What --images names: a folder or file as a path, a glob as it is."""
    return text if any(c in text for c in "*?[") else Path(text)


def raw_layout(text: str | None) -> Any:
    """`2048x2048:<u2:512` as a RawLayout: rows x columns, type with endianness, bytes of header."""
    import tomopose as tp

    if text is None:
        return None
    found = RAW.fullmatch(text)
    if not found:
        raise typer.BadParameter(f"{text!r} is not NVxNU:TYPE[:HEADER_BYTES]", param_hint="--raw")
    return tp.RawLayout(
        shape=(int(found["n_v"]), int(found["n_u"])), dtype=found["dtype"], header=int(found["header"] or 0)
    )


def open_for(
    say: Say,
    source: str | Path,
    scanner: Scanner,
    poses: PoseSequence | None,
    *,
    dark: str | None = None,
    flat: str | None = None,
    dataset: str | None = None,
    rows: str | None = None,
    raw: str | None = None,
) -> Any:
    """The images of a pose table, in its order; without a table, all images in natural order."""
    import tomopose as tp

    if rows not in (None, "top-first", "bottom-first"):
        raise typer.BadParameter(f"{rows!r} is neither top-first nor bottom-first", param_hint="--rows")
    order: Any = rows
    images = tp.open_images(
        source, scanner, dark=dark, flat=flat, dataset=dataset, rows=order, raw_layout=raw_layout(raw)
    )
    for warning in images.warnings:
        say.note(f"note: {warning}")
    return images if poses is None else images.select(tp.pair_images(poses, images))


def forward_of(machine: ErrorModel | None) -> Any:
    """The forward kinematics of a robot with joint values, for tables that hold nothing else."""
    from tomopose.manipulator.serial import SerialRobot

    return machine.forward if isinstance(machine, SerialRobot) else None


def note_missing_flat(say: Say, flat: str | None) -> None:
    """Says what becomes of radiographs that nobody has corrected."""
    if flat is None:
        say.note(
            "note: no flat field given; unless the radiographs are corrected already, pixel gains count as noise "
            "and the background is fitted round the ball alone"
        )


@contextlib.contextmanager
def executor_of(dask: str | None) -> Iterator[Any]:
    """A client of the dask scheduler at that address, closed afterwards; None without an address."""
    if dask is None:
        yield None
        return
    try:
        from distributed import Client
    except ImportError as error:
        from tomopose.errors import EngineMissingError

        raise EngineMissingError("dask is not installed", install_line='pip install "tomopose[dask]"') from error
    make_client: Any = Client
    with make_client(dask) as client:
        yield client


def require_free_folder(out: Path, *, force: bool) -> None:
    """FileError, before any work is done, where the results would overwrite what is there."""
    from tomopose.files import require_absent

    for name in ("calibration.json", "observations.csv", "report.html", "job.json"):
        require_absent(out / name, force=force)


def observe(
    say: Say,
    scanner: Scanner,
    images: ImageSequence,
    poses: PoseSequence | None,
    *,
    ball_diameter: float | Mapping[int, float] | None,
    workers: int = 1,
    **options: Any,
) -> BallObservations:
    """Find the ball in each image.  Without poses the ids are the images' names without suffix."""
    import tomopose as tp

    if ball_diameter is None:
        raise typer.BadParameter("give the ball's nominal diameter, mm", param_hint="--ball-diameter-mm")
    ids = [Path(name).stem for name in images.names] if poses is None else poses.pose_id
    with say.progress("detecting") as progress:
        found = tp.detect(
            images, scanner, ball_diameter=ball_diameter, pose_id=ids, workers=workers, progress=progress, **options
        )
    only = None if isinstance(ball_diameter, Mapping) else ball_diameter
    return replace(found, image=tuple(Path(name).name for name in images.names), ball_diameter=only)


def worst(calibration: Calibration, observations: BallObservations, images: ImageSequence) -> tuple[Thumbnail, ...]:
    """Pictures of the images that deserve a look: those not measured first, then the largest residuals."""
    from tomopose.report import worst_thumbnails

    residuals = dict(zip(calibration.pose_id, calibration.d.tolist(), strict=True))
    return worst_thumbnails(observations, images, residuals=residuals)


def write_calibration_folder(
    out: Path,
    calibration: Calibration,
    observations: BallObservations,
    poses: PoseSequence,
    *,
    images: ImageSequence | None = None,
    scan: ProjectionMatrices | None = None,
    decisions: Sequence[Decision] = (),
    job: Mapping[str, object] | None = None,
    force: bool = False,
) -> None:
    """calibration.json, observations.csv and report.html, all or none; job.json and decisions.jsonl, where given."""
    import tomopose as tp
    from tomopose.calibration.records.decisions import write_decisions
    from tomopose.files import atomic_folder, write_json
    from tomopose.report import calibration_report, write_report

    pictures = () if images is None else worst(calibration, observations, images)
    with atomic_folder(out, force=force) as folder:
        tp.write_calibration(folder / "calibration.json", calibration)
        tp.write_observations(folder / "observations.csv", observations)
        if job is not None:
            write_json(folder / "job.json", "job", job)
        if decisions:
            write_decisions(folder / "decisions.jsonl", decisions)
        html = calibration_report(
            calibration,
            observations=observations,
            poses=poses,
            thumbnails=pictures,
            scan=scan,
            decisions=decisions,
        )
        write_report(folder / "report.html", html)


def finding_rows(checks: Iterable[Finding]) -> list[dict[str, object]]:
    """The findings of a result, for programs."""
    return [{"rule": f.rule, "words": f.words, "cure": f.remedy, "verdict": f.verdict} for f in checks]


def assumed_rows(assumed: Iterable[Assumed]) -> list[dict[str, object]]:
    """What was taken with an uncertainty that was not measured, for programs."""
    return [{"name": a.name, "sigma": a.sigma, "unit": a.unit, "from": a.source} for a in assumed]


def calibration_summary(calibration: Calibration) -> tuple[dict[str, Any], list[str]]:
    """The figures of a calibration, for programs and for people."""
    from tomopose.calibration.model.parameters import UNITS as units
    from tomopose.units import value_with_uncertainty

    # The mount, the balls and the scanner are a dozen numbers; a manipulator's errors would drown them.
    shown = [p for p in calibration.parameters if p.name.startswith(("phi_HT", "t_HT", "t_", "t[")) or p.name in units]
    more = len(calibration.parameters) - len(shown)
    summary = {
        "verdict": calibration.verdict,
        "reasons": list(calibration.reasons),
        "d_rms_px": calibration.d_rms,
        "d_rms_um": calibration.d_rms_um,
        "chi2_dof": calibration.chi2_dof,
        "poses_used": len(calibration.pose_id),
        "outliers": dict(calibration.outliers),
        "model": calibration.model,
        "findings": finding_rows(calibration.checks),
        "explanations": [e.words for e in calibration.explanations],
        "assumed": assumed_rows(calibration.assumed),
        "scan_px": None if calibration.budget is None else calibration.budget.total,
        "parameters": [{"name": p.name, "value": p.value, "u": p.u, "unit": p.unit} for p in calibration.parameters],
    }
    lines = [
        f"{calibration.verdict}: {calibration.status}{first_explanation(calibration)}",
        *(f"  - {line}" for line in doubts(calibration)),
        *(f"  {words}" for words in notes(calibration)),
        f"  d_rms {calibration.d_rms:.4g} px ({calibration.d_rms_um:.3g} um at the object), "
        f"{len(calibration.pose_id)} poses, {len(calibration.outliers)} set aside",
        *(f"  {p.name:<10} {value_with_uncertainty(p.value, p.u, p.unit)}" for p in shown),
        *([f"  and {more} of the manipulator's own errors (--json and the report list them)"] if more else []),
    ]
    return summary, lines


def doubts(calibration: Calibration) -> list[str]:
    """Every reason for doubt, worst first, with what to do where something is known and the reason does not say it."""
    found = sorted((f for f in calibration.checks if f.verdict != "trustworthy"), key=lambda f: f.verdict != "rejected")
    return [f.words if not f.remedy or f.remedy in f.words else f"{f.words}; {f.remedy}" for f in found]


def first_explanation(calibration: Calibration) -> str:
    """What explains best why the scanner's values as declared do not fit, for the first line; "" where they do."""
    explained = calibration.explanations
    return f"; {explained[0].words}" if explained else ""


def notes(calibration: Calibration) -> list[str]:
    """Findings worth knowing that give no doubt, and what the uncertainty of a scan is made of."""
    from tomopose.calibration.model.budget import budget_words

    lines = [f"note: {f.words}" for f in calibration.checks if f.verdict == "trustworthy"]
    return lines if calibration.budget is None else [budget_words(calibration.budget, calibration.assumed), *lines]


def exit_code(calibration: Calibration) -> int:
    return OK if calibration.verdict == "trustworthy" else NOT_TRUSTWORTHY
