"""The project file `tomopose.toml`: what every verb takes where its options do not say it.

A flat table of file names and numbers, and `[certificates]` with whatever belongs on a certificate.  File names are
relative to the file.  Options on the command line win.
"""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import typer

from tomopose.errors import InputError
from tomopose.reading import parse_toml, read_text

NAME = "tomopose.toml"
FILES = (
    "scanner", "poses", "images", "manipulator", "limits", "dark", "flat", "calibration", "scan", "matrices", "part",
)  # fmt: skip
"""Keys that name files or folders."""
NUMBERS = ("ball_diameter_mm", "workers", "kv", "voxel_mm")
WORDS = ("rows", "raw", "dataset", "material", "size")
FACTS: Mapping[str, str] = {
    "machine": "machine",
    "serial": "serial number",
    "operator": "operator",
    "ball_certificate": "certificate of the ball",
    "scanner_certificate": "certificate of the scanner",
    "temperature_C": "temperature, deg C",
    "valid_until": "valid until",
    "order": "order",
    "customer": "customer",
}
"""Keys that appear in reports, and their words; `[certificates]` takes any other name too."""
COMMON: Mapping[str, str] = {
    "--scanner": "scanner",
    "--images": "images",
    "--ball-diameter-mm": "ball_diameter_mm",
    "--manipulator": "manipulator",
    "--limits": "limits",
    "--dark": "dark",
    "--flat": "flat",
    "--raw": "raw",
    "--dataset": "dataset",
    "--workers": "workers",
    "--calibration": "calibration",
    "--matrices": "matrices",
    "--part": "part",
    "--material": "material",
    "--kv": "kv",
    "--voxel-mm": "voxel_mm",
    "--size": "size",
}
"""Option -> key, for every verb that has the option."""
OF_VERB: Mapping[tuple[str, str], str | None] = {
    **{(verb, "--poses"): "poses" for verb in ("detect", "calibrate", "diagnose")},
    **{(verb, "--rows"): "rows" for verb in ("detect", "calibrate", "diagnose")},
    ("matrices", "--poses"): "scan",
    ("matrices", "--out"): "matrices",
    ("import-scanner", "--out"): "scanner",
    ("import-poses", "--out"): "poses",
    ("matrices", "--scanner"): None,
    ("matrices", "--manipulator"): None,
    ("simulate", "--workers"): None,
}
"""(Verb, option) -> key where a verb's option means something else; None: the option takes nothing from the file."""
WITHOUT = ("init", "doctor", "demo", "study", "import-geometry")
"""Verbs that take nothing from a project file."""
FACTS_ALONE = ("report",)
"""Verbs that take from it what appears in reports, and no defaults: a folder of results says what it was made from."""
AGAINST: Mapping[str, tuple[str, ...]] = {"images": ("--observations",), "manipulator": ("--twin",)}
"""Keys that an option excludes."""


@dataclass(frozen=True, kw_only=True)
class Project:
    """A project file.  values: key -> value; facts: what appears in reports."""

    path: Path
    values: Mapping[str, Any] = field(default_factory=dict)
    facts: Mapping[str, str] = field(default_factory=dict)

    def value_of(self, key: str) -> Any:
        """A value as an option takes it: file names from the folder of the project file."""
        value = self.values[key]
        if key not in FILES or any(c in str(value) for c in "*?["):
            return value
        return str(self.path.parent / str(value))

    def defaults(self, verb: str, options: Mapping[str, str], given: Sequence[str]) -> dict[str, Any]:
        """Parameter name -> default of a verb.  options: option -> parameter name; given: the words of the line."""
        used = {word.split("=", 1)[0] for word in given if word.startswith("--")}
        out = {}
        for option, parameter in options.items():
            key = OF_VERB.get((verb, option), COMMON.get(option))
            if key is None or key not in self.values or used & set(AGAINST.get(key, ())):
                continue
            out[parameter] = self.value_of(key)
        return out


def without_project(words: Sequence[str]) -> tuple[list[str], str | None]:
    """The words of a command line without `--project FILE`, and that file's name."""
    rest: list[str] = []
    named = None
    waiting = False
    for word in words:
        if waiting:
            named, waiting = word, False
        elif word == "--project":
            waiting = True
        elif word.startswith("--project="):
            named = word.split("=", 1)[1]
        else:
            rest.append(word)
    return ([*rest, "--project"] if waiting else rest), named


def project_for(words: Sequence[str], named: str | None) -> Project | None:
    """The project of a command line: the file that it names, or the one of the working folder.

    Verbs that take nothing from it, and --help, do not read it: a damaged one must not lock anybody out.
    """
    verb = next((word for word in words if not word.startswith("-")), "")
    if verb in WITHOUT or not verb or "--help" in words:
        return None
    project = find_project(named, Path.cwd())
    return replace(project, values={}) if project is not None and verb in FACTS_ALONE else project


def default_map(command: Any, project: Project | None, words: Sequence[str], verb: str = "") -> dict[str, Any]:
    """The defaults of every verb of a command tree, by parameter name, as click takes them."""
    if project is None:
        return {}
    out: dict[str, Any] = {}
    for name, child in getattr(command, "commands", {}).items():
        if hasattr(child, "commands"):
            out[name] = default_map(child, project, words, name)
            continue
        options = {option: p.name for p in child.params for option in p.opts if option.startswith("--")}
        out[name] = project.defaults(f"{verb} {name}".strip(), options, words)
    return out


def current_facts() -> dict[str, str]:
    """What the project of the running verb says for its reports; empty where there is no project."""
    core = typer.Context.__mro__[1].__module__.rpartition(".")[0]
    context = importlib.import_module(f"{core}.globals").get_current_context(silent=True)
    project = None if context is None else context.find_root().obj
    return dict(project.facts) if isinstance(project, Project) else {}


def find_project(given: str | None, folder: Path) -> Project | None:
    """The project file that is asked for, or the one of the working folder; None if none is found."""
    if given is not None:
        return read_project(Path(given))
    path = folder / NAME
    return read_project(path) if path.is_file() else None


def read_project(path: Path) -> Project:
    """Read a project file.  FileError where it cannot be read, InputError for an unknown key or a wrong type."""
    content = dict(parse_toml(read_text(path), path))
    certificates = content.pop("certificates", {})
    if not isinstance(certificates, dict):
        raise InputError(f"{path}: certificates is {certificates!r}; a table [certificates] is needed")
    values: dict[str, Any] = {}
    facts: dict[str, str] = {}
    for key, value in content.items():
        if key in FACTS:
            facts[key] = str(value)
        elif key in FILES + WORDS + NUMBERS:
            values[key] = _checked(path, key, value)
        else:
            near = difflib.get_close_matches(key, [*FILES, *WORDS, *NUMBERS, *FACTS], n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise InputError(
                f"{path}: unknown key {key!r}{hint} Known are: {', '.join((*FILES, *WORDS, *NUMBERS, *FACTS))}"
            )
    facts |= {str(k): str(v) for k, v in certificates.items()}
    return Project(path=path, values=values, facts=facts)


def _checked(path: Path, key: str, value: object) -> Any:
    if key in NUMBERS:
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise InputError(f"{path}: {key} is {value!r}; a number is needed")
        return value
    if not isinstance(value, str) or not value:
        raise InputError(f"{path}: {key} is {value!r}; text is needed")
    return value


def project_text(values: Mapping[str, object], facts: Mapping[str, str]) -> str:
    """The text of a project file: what is known, and what else may be said, as remarks."""
    lines = [
        "# What every tomopose verb takes where its options do not say it; file names are relative to this file.",
        "",
    ]
    for key in (*FILES, *WORDS, *NUMBERS):
        if key in values:
            value = values[key]
            lines.append(f"{key} = {value}" if key in NUMBERS else f"{key} = {_quoted(str(value))}")
        elif key in ("manipulator", "limits", "rows", "dark", "flat", "scan", "ball_diameter_mm"):
            lines.append(f"# {key} = ...")
    lines += ["", "# These appear in every report."]
    lines += [f"{k} = {_quoted(facts[k])}" if k in facts else f"# {k} = ..." for k in FACTS]
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'
