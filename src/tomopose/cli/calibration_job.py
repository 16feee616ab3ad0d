"""job.json: the options of a calibration, so that a review finds its files and solves as it was solved.

File names are relative to the folder of the result, so that a project may be moved as a whole.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING

from tomopose.errors import FileError, InputError
from tomopose.files import read_json

if TYPE_CHECKING:
    from tomopose.cli.calibration_options import Options

NAME = "job.json"
FILES = ("scanner", "poses", "observations", "manipulator", "twin", "source_poses")
SOURCES = ("images", "dark", "flat")
"""Options that name files: paths, and texts that may hold a pattern."""
NOT_KEPT = ("out", "force", "as_json", "quiet", "review", "workers")


def job_of(options: Options, out: Path) -> dict[str, object]:
    """The options as job.json holds them; out: the folder that it will lie in."""
    kept: dict[str, object] = {}
    for f in fields(options):
        value = getattr(options, f.name)
        if f.name in NOT_KEPT or value is None:
            continue
        kept[f.name] = _relative(str(value), out) if f.name in FILES + SOURCES else value
    return {"options": kept}


def _relative(name: str, out: Path) -> str:
    try:
        return Path(os.path.relpath(name, out)).as_posix()
    except ValueError:  # another drive
        return Path(name).resolve().as_posix()


def options_of(folder: Path, given: Mapping[str, object]) -> Options:
    """The options of the calibration in a folder; what is given counts where job.json does not say.

    FileError where there is no job.json and what is given does not name scanner and poses; InputError for a bad one.
    """
    from tomopose.cli.calibration_options import Options

    path = folder / NAME
    content = read_json(path, "job").get("options") if path.is_file() else {}
    if not isinstance(content, dict):
        raise InputError(f"{path}: options is not an object")
    known = {f.name for f in fields(Options)} - set(NOT_KEPT)
    unknown = sorted(set(content) - known)
    if unknown:
        raise InputError(f"{path}: unknown option {unknown[0]!r}")
    values: dict[str, object] = {}
    for name, value in content.items():
        if name in FILES + SOURCES:
            if not isinstance(value, str):
                raise InputError(f"{path}: {name} is {value!r}; a file name is needed")
            place = os.path.normpath(folder / value)
            value = Path(place) if name in FILES else place
        values[name] = value
    values = {k: v for k, v in given.items() if v is not None} | values
    if not {"images", "observations"} & values.keys():
        values["observations"] = folder / "observations.csv"
    missing = [k for k in ("scanner", "poses") if k not in values]
    if missing:
        raise FileError(
            f"{folder} holds no {NAME}, so the files of the calibration are not known; give "
            + " and ".join(f"--{k}" for k in missing),
            path=path,
        )
    return Options(out=folder, **values)  # type: ignore[arg-type]
