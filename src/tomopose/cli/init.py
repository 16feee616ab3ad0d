"""`tomopose init`: a project file, and scanner.json and poses.csv from the files that are there."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from tomopose.cli.common import OK
from tomopose.cli.options import WritingOptions, add_command
from tomopose.cli.project import NAME, project_text

EPILOG = (
    "Example: tomopose init --from part.xtekct --from poses.csv --images radiographs --ball-diameter-mm 8\n\n"
    "Then: tomopose calibrate --out cal"
)


def register(app: typer.Typer) -> None:
    add_command(app, "init", init, epilog=EPILOG)


@dataclass(frozen=True, kw_only=True)
class Options(WritingOptions):
    """The options of `tomopose init`."""

    folder: Annotated[Path, typer.Argument(help="Folder of the project.")] = Path()
    sources: Annotated[
        list[Path] | None,
        typer.Option("--from", help="A scanner's file, a log of poses or a folder of images; may be repeated."),
    ] = None
    images: Annotated[str | None, typer.Option("--images", help="Folder, glob or file of radiographs.")] = None
    ball_diameter: Annotated[
        float | None, typer.Option("--ball-diameter-mm", help="Nominal diameter of the ball, mm.")
    ] = None
    machine: Annotated[str | None, typer.Option("--machine", help="The machine's name, for reports.")] = None
    operator: Annotated[str | None, typer.Option("--operator", help="The operator's name, for reports.")] = None


@dataclass(frozen=True, kw_only=True)
class Found:
    """What the files gave: project values, files to write (name -> text or JSON), and what to say."""

    values: dict[str, Any]
    texts: dict[str, str]
    documents: dict[str, Any]
    notes: list[str]


def init(options: Options) -> int:
    """Start a project: tomopose.toml states once what every verb needs.

    Files of a scanner, of poses and of images are recognised; scanner.json and poses.csv are written from them.  On a
    terminal, what is missing is asked for.
    """
    from tomopose.files import require_absent, write_json, write_text
    from tomopose.provenance import provenance

    o, say = options, options.say
    target = require_absent(o.folder / NAME, force=o.force)
    found = look_at(o)
    facts = {k: v for k, v in (("machine", o.machine), ("operator", o.operator)) if v}
    if sys.stdin.isatty() and not o.quiet and not o.as_json:
        ask(found.values, facts)
    for name in (*found.texts, *found.documents):
        require_absent(o.folder / name, force=o.force)
    made = provenance(inputs=[p for p in o.sources or () if p.is_file()], arguments={})
    for name, text in found.texts.items():
        write_text(o.folder / name, text)
    for name, document in found.documents.items():
        write_json(o.folder / name, "scanner", {**document, "provenance": made.to_json()})
    write_text(target, project_text(found.values, facts))
    for note in found.notes:
        say.note(note)
    needed = [k for k in ("scanner", "poses", "images", "ball_diameter_mm") if k not in found.values]
    say.result(
        {"out": NAME, "values": found.values, "written": [*found.texts, *found.documents], "missing": needed},
        [
            f"{target}: {', '.join(found.values) or 'nothing known yet'}"
            + (f"; not known: {', '.join(needed)}" if needed else "; next: tomopose calibrate --out cal")
        ],
    )
    return OK


def look_at(o: Options) -> Found:
    """Recognise the files that are given."""
    from tomopose.io.foreign.foreign_file import ForeignFile
    from tomopose.io.foreign.registry import kind_of

    found = Found(values={}, texts={}, documents={}, notes=[])
    spare: list[Path] = []
    for path in o.sources or ():
        if path.is_dir():
            found.values["images"] = relative(path, o.folder)
            continue
        if own(path, o.folder, found):
            continue
        kind = kind_of(ForeignFile(path))
        scanner = kind is not None and kind.read_scanner is not None
        poses = kind is not None and kind.read_poses is not None
        if scanner:
            take_scanner(path, found)
        if scanner and poses:  # an NXtomo file holds images, and table angles where no log says more
            found.values["images"] = relative(path, o.folder)
            spare.append(path)
        elif poses:
            take_poses(path, found)
        if not scanner and not poses:
            take_poses(path, found)  # raises, and says what the file is and how to proceed
    if spare and "poses" not in found.values:
        take_poses(spare[0], found)
    if o.images is not None:
        found.values["images"] = o.images if any(c in o.images for c in "*?[") else relative(Path(o.images), o.folder)
    if o.ball_diameter is not None:
        found.values["ball_diameter_mm"] = o.ball_diameter
    return found


def own(path: Path, folder: Path, found: Found) -> bool:
    """Whether a file is one of tomopose's own, which is named and not written again."""
    head = path.read_bytes()[:400] if path.is_file() else b""
    if b"tomopose/scanner/" in head:
        found.values["scanner"] = relative(path, folder)
    elif b"tomopose/hexapod/" in head or b"tomopose/serial/" in head:
        found.values["manipulator"] = relative(path, folder)
    elif b"pose_id" in head and b"x_mm" in head:
        found.values["poses"] = relative(path, folder)
    else:
        return False
    return True


def take_scanner(path: Path, found: Found) -> None:
    from tomopose.io import read_scanner_draft

    draft = read_scanner_draft(path)
    found.documents["scanner.json"] = draft.document()
    found.values["scanner"] = "scanner.json"
    found.notes.extend(draft.lines())


def take_poses(path: Path, found: Found) -> None:
    from tomopose.io import read_pose_log
    from tomopose.io.foreign.pose_log import table_text

    log = read_pose_log(path)
    log.poses()
    found.texts["poses.csv"] = table_text(log.table())
    found.values["poses"] = "poses.csv"
    found.notes.extend(f"{path.name}: {note}" for note in log.notes)


def relative(path: Path, folder: Path) -> str:
    """A file's name from the project's folder, where that is possible."""
    import os

    try:
        return Path(os.path.relpath(path.absolute(), folder.absolute())).as_posix()
    except ValueError:  # another drive
        return str(path.absolute())


def ask(values: dict[str, object], facts: dict[str, str]) -> None:
    """Ask on the terminal for what is not known; an empty answer leaves it out."""
    for key, question in (
        ("scanner", "scanner.json"),
        ("poses", "poses.csv"),
        ("images", "folder of radiographs"),
        ("ball_diameter_mm", "diameter of the ball, mm"),
    ):
        if key in values:
            continue
        answer = typer.prompt(question, default="", show_default=False, err=True).strip()
        if answer:
            values[key] = float(answer) if key == "ball_diameter_mm" else answer
    for key in ("machine", "operator"):
        if key not in facts:
            answer = typer.prompt(key, default="", show_default=False, err=True).strip()
            facts |= {key: answer} if answer else {}
