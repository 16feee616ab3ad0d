"""A verb's options as one frozen value.

A verb is a function of one argument, a frozen dataclass whose fields are the options: `Annotated[type,
typer.Option(...)]` with the default of the field.  Groups of options that several verbs share are base classes.

    @dataclass(frozen=True, kw_only=True)
    class Options(ImageFileOptions, SpokenOptions):
        out: Annotated[Path, typer.Option("--out", help="Folder to write.")]

    def verb(options: Options) -> int: ...

    add_command(app, "verb", verb, epilog=EPILOG)
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Annotated, TypeVar, get_type_hints

import typer

from tomopose.cli.common import Say

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class SpokenOptions:
    """How a verb speaks."""

    as_json: Annotated[bool, typer.Option("--json", help="Print the result as one JSON object on standard output.")] = (
        False
    )
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False

    @property
    def say(self) -> Say:
        return Say(json=self.as_json, quiet=self.quiet)


@dataclass(frozen=True, kw_only=True)
class WritingOptions(SpokenOptions):
    """Options of a verb that writes files."""

    force: Annotated[bool, typer.Option("--force", help="Overwrite files that exist.")] = False


@dataclass(frozen=True, kw_only=True)
class ImageFileOptions:
    """How image files are read."""

    dark: Annotated[str | None, typer.Option("--dark", help="Dark frames, with --flat.")] = None
    flat: Annotated[str | None, typer.Option("--flat", help="Flat frames: images become transmission.")] = None
    dataset: Annotated[str | None, typer.Option("--dataset", help="Dataset in an HDF5 file.")] = None
    rows: Annotated[
        str | None,
        typer.Option("--rows", help="Row order of the image files, top-first or bottom-first; overrides scanner.json."),
    ] = None
    raw: Annotated[
        str | None,
        typer.Option("--raw", help="Layout of RAW files, NVxNU:TYPE[:HEADER_BYTES], e.g. 2048x2048:<u2:512."),
    ] = None


@dataclass(frozen=True, kw_only=True)
class ObservedOptions(ImageFileOptions):
    """Radiographs, or the ball centres that were found in them."""

    images: Annotated[str | None, typer.Option("--images", help="Folder, glob or multi-page file of radiographs.")] = (
        None
    )
    observations: Annotated[
        Path | None, typer.Option("--observations", help="observations.csv, instead of --images.")
    ] = None
    workers: Annotated[int, typer.Option("--workers", min=1, help="Processes to use.")] = 1


def add_command(app: typer.Typer, name: str, verb: Callable[[T], int], *, epilog: str) -> None:
    """Register a verb whose one parameter `options` is annotated with its dataclass of options."""
    kind = get_type_hints(verb)["options"]
    hints = get_type_hints(kind, include_extras=True)

    def command(**values: object) -> int:
        return verb(kind(**values))

    parameters = [
        inspect.Parameter(
            f.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if f.default is MISSING else f.default,
            annotation=hints[f.name],
        )
        for f in sorted(fields(kind), key=lambda f: _place(kind, f.name))
    ]
    command.__doc__ = verb.__doc__
    command.__annotations__ = {p.name: p.annotation for p in parameters} | {"return": int}
    vars(command)["__signature__"] = inspect.Signature(parameters, return_annotation=int)
    app.command(name, epilog=epilog)(command)


def _place(kind: type, name: str) -> int:
    """--help shows a verb's own options first, then those of its groups, how it speaks last."""
    return next(k for k, home in enumerate(kind.__mro__) if name in inspect.get_annotations(home))
