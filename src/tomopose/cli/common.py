"""What every verb shares: options, progress, and the two ways of saying a result (for people, for programs)."""

from __future__ import annotations

import codecs
import contextlib
import io
import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from tomopose.provenance import Provenance

OK, BAD_INPUT, USAGE, NOT_TRUSTWORTHY, MISSING, INTERNAL = 0, 1, 2, 3, 4, 70
INTERRUPTED, TERMINATED = 130, 143
"""As shells say it: 128 and the signal's number."""

Progress = Callable[[int, int], None]

JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as one JSON object on standard output.")]
QuietOption = Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")]
ForceOption = Annotated[bool, typer.Option("--force", help="Overwrite files that exist.")]
ScannerOption = Annotated[Path, typer.Option("--scanner", help="scanner.json: the scanner's known geometry.")]
PosesOption = Annotated[Path, typer.Option("--poses", help="poses.csv: the manipulator's poses, one row an image.")]
SourcePosesOption = Annotated[
    Path | None,
    typer.Option("--source-poses", help="Twin robots: poses or joint values of the source's robot, by pose_id."),
]
WorkersOption = Annotated[int, typer.Option("--workers", min=1, help="Processes to use.")]
ImagesOption = Annotated[str | None, typer.Option("--images", help="Folder, glob or multi-page file of radiographs.")]
ObservationsOption = Annotated[
    Path | None, typer.Option("--observations", help="observations.csv, instead of --images.")
]
DarkOption = Annotated[str | None, typer.Option("--dark", help="Dark frames, with --flat.")]
FlatOption = Annotated[str | None, typer.Option("--flat", help="Flat frames: images become transmission.")]
DatasetOption = Annotated[str | None, typer.Option("--dataset", help="Dataset in an HDF5 file.")]
RowsOption = Annotated[
    str | None,
    typer.Option("--rows", help="Row order of the image files, top-first or bottom-first; overrides scanner.json."),
]
RawOption = Annotated[
    str | None, typer.Option("--raw", help="Layout of RAW files, NVxNU:TYPE[:HEADER_BYTES], e.g. 2048x2048:<u2:512.")
]
DaskOption = Annotated[str | None, typer.Option("--dask", help="Address of a dask scheduler to use.")]


IN_ASCII = {"µ": "u", "−": "-", "–": "-", "×": "x", "°": " deg", "±": "+-", "σ": "sigma", "²": "2", "…": "..."}
"""How a terminal without these characters shows them."""


def _shown_otherwise(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    part = error.object[error.start : error.end]
    return "".join(IN_ASCII.get(c, "?") for c in part), error.end


def speak_any_terminal() -> None:
    """Text that the terminal's encoding does not have is shown by other characters, never as an error."""
    codecs.register_error("tomopose", _shown_otherwise)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="tomopose")


def tell(text: str) -> None:
    """A line for people on standard error; where the stream is closed, the work continues."""
    with contextlib.suppress(OSError, ValueError):
        print(text, file=sys.stderr, flush=True)


def as_line(document: Mapping[str, object]) -> str:
    """JSON in one line, in characters that standard output has."""
    unicode = (sys.stdout.encoding or "").lower().replace("-", "").startswith("utf")
    return json.dumps(document, ensure_ascii=not unicode, allow_nan=False)


@dataclass(frozen=True, kw_only=True)
class Say:
    """How a verb speaks: results to standard output, notes and progress to standard error."""

    json: bool = False
    quiet: bool = False

    def note(self, text: str) -> None:
        if not self.quiet and not self.json:
            tell(text)

    def result(self, summary: Mapping[str, object], lines: Sequence[str] = ()) -> None:
        """The summary as JSON, or its lines for people."""
        from tomopose.files import plain

        if self.json:
            print(as_line(plain(summary)))
        elif not self.quiet:
            for line in lines:
                print(line)

    @contextlib.contextmanager
    def progress(self, label: str) -> Iterator[Progress]:
        """A bar with the time left on a terminal, a plain line at every tenth elsewhere, nothing when quiet."""
        if self.quiet or self.json:
            yield lambda done, total: None
        elif sys.stderr.isatty():
            yield from _bar(label)
        else:
            yield from _lines(label)


def _bar(label: str) -> Iterator[Progress]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.progress import Progress as RichProgress

    from tomopose.kernel_cache import reporting_compiling

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with RichProgress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(label, total=None)

        def compiling(now: bool) -> None:
            bar.update(task, description="compiling" if now else label)

        with reporting_compiling(compiling):
            yield lambda done, total: bar.update(task, completed=done, total=total)


def _lines(label: str) -> Iterator[Progress]:
    from tomopose.kernel_cache import reporting_compiling

    start = time.monotonic()  # later by what was spent on compiling, which the remaining work does not repeat
    said, told, began = -1, False, 0.0

    def compiling(now: bool) -> None:
        nonlocal told, start, began
        if now:
            began = time.monotonic()
        else:
            start += time.monotonic() - began
        if not told:
            told = True
            tell(f"{label}: compiling what this command needs, once for this installation")

    def update(done: int, total: int) -> None:
        nonlocal said
        tenth = 10 * done // max(total, 1)
        if tenth > said:
            said = tenth
            elapsed = time.monotonic() - start
            left = f", {elapsed * (total - done) / done:.0f} s left" if 0 < done < total else ""
            tell(f"{label}: {done} of {total}{left}")

    with reporting_compiling(compiling):
        yield update


def either(images: str | None, observations: Path | None) -> None:
    """A usage error unless exactly one of the two is given."""
    if (images is None) == (observations is None):
        raise typer.BadParameter("give either --images or --observations", param_hint="--images / --observations")


def names(text: str | None) -> tuple[str, ...]:
    """`a,b,c` as names."""
    return tuple(part.strip() for part in text.split(",") if part.strip()) if text else ()


def arguments(**values: object) -> dict[str, Any]:
    """The arguments of a verb for the provenance: paths by their names alone, and the project's facts for reports."""
    from tomopose.cli.project import current_facts
    from tomopose.provenance import MEASUREMENT

    said = {k: v.name if isinstance(v, Path) else v for k, v in values.items() if v is not None}
    facts = current_facts()
    return {**said, MEASUREMENT: facts} if facts else said


def with_facts(made: Provenance) -> Provenance:
    """The provenance of an earlier result, with the project's facts where it says nothing of the machine."""
    from tomopose.provenance import MEASUREMENT

    return made if MEASUREMENT in made.arguments else replace(made, arguments={**made.arguments, **arguments()})
