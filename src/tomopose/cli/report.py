"""`tomopose report`: one offline HTML file from a result folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tomopose.cli.common import OK, ForceOption, JsonOption, QuietOption, Say, arguments, with_facts

if TYPE_CHECKING:
    from tomopose import Calibration

EPILOG = (
    "Example: tomopose report cal/ --poses poses.csv --scan matrices.npz --force\n\n"
    "Paper: tomopose report cal/ --poses poses.csv --pdf cal/report.pdf --certificate certificate/ --force"
)


def register(app: typer.Typer) -> None:
    app.command("report", epilog=EPILOG)(report)


def report(
    folder: Annotated[Path, typer.Argument(help="Folder with calibration.json, observations.csv or matrices.npz.")],
    poses: Annotated[Path | None, typer.Option("--poses", help="poses.csv, for the plots by axis and angle.")] = None,
    images: Annotated[str | None, typer.Option("--images", help="Radiographs, for pictures of detections.")] = None,
    history: Annotated[
        Path | None, typer.Option("--history", help="History file of `tomopose monitor`, for control charts.")
    ] = None,
    scan: Annotated[Path | None, typer.Option("--scan", help="matrices.npz of a scan, for its effect.")] = None,
    out: Annotated[Path | None, typer.Option("--out", help="The HTML file; default report.html in the folder.")] = None,
    pdf: Annotated[
        Path | None, typer.Option("--pdf", help="The same as PDF, printed by an installed Chromium.")
    ] = None,
    certificate: Annotated[
        Path | None,
        typer.Option(
            "--certificate",
            help="Folder for the certificate: certificate.html to sign, certificate.xml (DCC); with --pdf a PDF too.",
        ),
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Write one HTML file that needs no network: verdict, parameters, residuals, pictures, the scene in 3D."""
    import tomopose as tp
    from tomopose.calibration.records.decisions import read_decisions
    from tomopose.calibration.records.history import read_history
    from tomopose.cli.job import image_source, open_for, worst
    from tomopose.errors import FileError
    from tomopose.files import require_absent
    from tomopose.io.matrices_npz import read_matrices_provenance
    from tomopose.provenance import provenance
    from tomopose.report import calibration_report, matrices_report, observations_report, write_report
    from tomopose.report.printing import write_pdf

    say = Say(json=as_json, quiet=quiet)
    target = require_absent(out or folder / "report.html", force=force)
    calibration_file, observations_file = folder / "calibration.json", folder / "observations.csv"
    observations = tp.read_observations(observations_file) if observations_file.exists() else None
    sequence = None if poses is None else tp.read_poses(poses)
    calibration = tp.read_calibration(calibration_file) if calibration_file.exists() else None
    if calibration is not None and calibration.provenance is not None:
        calibration = replace(calibration, provenance=with_facts(calibration.provenance))
    pictures: tuple[Any, ...] = ()
    if images is not None and observations is not None and calibration is not None and sequence is not None:
        stack = open_for(say, image_source(images), calibration.scanner, sequence)
        pictures = worst(calibration, observations, stack)
    if calibration is not None:
        matrices = None if scan is None else tp.read_matrices(scan)
        html = calibration_report(
            calibration,
            observations=observations,
            poses=sequence,
            thumbnails=pictures,
            scan=matrices,
            history=() if history is None else read_history(history),
            decisions=read_decisions(folder / "decisions.jsonl") if (folder / "decisions.jsonl").exists() else (),
        )
    elif observations is not None:
        made = provenance(inputs=[observations_file], arguments=arguments())
        html = observations_report(observations, provenance=made)
    elif (folder / "matrices.npz").exists():
        matrices_file = folder / "matrices.npz"
        made = read_matrices_provenance(matrices_file) or provenance(inputs=[matrices_file])
        html = matrices_report(tp.read_matrices(matrices_file), provenance=with_facts(made))
    else:
        raise FileError(f"{folder} holds no calibration.json, observations.csv or matrices.npz", path=folder)
    written = [target, *(() if pdf is None else (require_absent(pdf, force=force),))]
    if certificate is not None:
        if calibration is None:
            raise FileError(f"{folder} holds no calibration.json, of which a certificate would be", path=folder)
        written += write_certificate(certificate, calibration, pdf=pdf is not None, force=force)
    write_report(target, html)
    if pdf is not None:
        write_pdf(pdf, html)
    say.result({"out": target.name, "files": [p.name for p in written]}, [f"{p}: written" for p in written])
    return OK


def write_certificate(folder: Path, calibration: Calibration, *, pdf: bool, force: bool) -> list[Path]:
    """certificate.html, certificate.xml and, where it is asked for, certificate.pdf; the files written."""
    from tomopose.cli.project import current_facts
    from tomopose.files import atomic_folder, write_text
    from tomopose.report.certificate.content import certificate_of
    from tomopose.report.certificate.dcc import dcc_xml
    from tomopose.report.certificate.page import certificate_report
    from tomopose.report.printing import write_pdf

    content = certificate_of(calibration, current_facts() or None)
    html = certificate_report(content)
    names = ["certificate.html", "certificate.xml", *(["certificate.pdf"] if pdf else [])]
    with atomic_folder(folder, force=force) as place:
        write_text(place / "certificate.html", html)
        write_text(place / "certificate.xml", dcc_xml(content))
        if pdf:
            write_pdf(place / "certificate.pdf", html)
    return [folder / name for name in names]
