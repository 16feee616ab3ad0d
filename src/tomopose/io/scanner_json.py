"""scanner.json: the scanner as it is known before a calibration."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tomopose.errors import InputError, UnitError
from tomopose.files import read_json, require_absent, write_json
from tomopose.geometry.scanner import PARAMETER_UNITS, Scanner
from tomopose.io.table_text import unknown_column
from tomopose.reading import reader
from tomopose.values import require_types

REQUIRED = ("d_SD", "d_SR", "p_u", "p_v", "u_0", "v_0")
COUNTS = ("n_u", "n_v")
KEYS: Mapping[str, str] = {f"{name}_{unit}": name for name, unit in PARAMETER_UNITS.items()}
"""File key -> parameter: `d_SD_mm` -> `d_SD`."""
COUNT_KEYS: Mapping[str, str] = {f"{name}_px": name for name in COUNTS}
KNOWN = (*KEYS, *COUNT_KEYS, "sigma", "image_rows", "certificate", "units", "provenance", "schema")

LARGEST_ROLL = 0.1
"""rad; a panel rolled or tilted by more than 6 deg (from a multiple of 90 deg, for the roll) is more likely a number
in degrees."""
PITCH_RANGE = (4.5e-4, 10.0)
"""mm; 0.2 mm is 0.0002 in metres and 200 in micrometres."""
DISTANCE_RANGE = (5.0, 1.0e5)
IF_RIGHT = 'if it is right, say so with "units": "confirmed"'


@reader("scanner.json")
def read_scanner(path: str | Path) -> Scanner:
    """Read scanner.json.  Raises InputError or UnitError by key, FileError, SchemaVersionError."""
    return scanner_from_document(read_json(path, "scanner"), str(path))


@require_types
def write_scanner(path: str | Path, scanner: Scanner, *, force: bool = False) -> None:
    """Write scanner.json.  FileError if the file exists and `force` is not given."""
    write_json(require_absent(path, force=force), "scanner", scanner_document(scanner))


def scanner_from_document(document: Mapping[str, object], where: str) -> Scanner:
    """The scanner in a JSON object; `where` begins the messages."""
    for key in document:
        if key not in KNOWN:
            _refuse(key, where)
    missing = [k for k, name in {**KEYS, **COUNT_KEYS}.items() if name in REQUIRED + COUNTS and k not in document]
    if missing:
        raise InputError(f"{where}: {', '.join(missing)} missing; a scanner needs all of {', '.join(_required_keys())}")
    values: dict[str, Any] = {}
    for key, name in {**KEYS, **COUNT_KEYS}.items():
        if key in document:
            values[name] = _number(document[key], f"{where}: {key}")
    sigma = document.get("sigma", {})
    if not isinstance(sigma, Mapping):
        raise InputError(f'{where}: sigma is no object {{"d_SD_mm": ...}}')
    for key in sigma:
        if key not in KEYS:
            _refuse(key, f"{where}: sigma")
    for key in ("image_rows", "certificate"):
        if key in document:
            if not isinstance(document[key], str):
                raise InputError(f"{where}: {key} is {document[key]!r}; text is needed")
            values[key] = document[key]
    units = document.get("units")
    if units not in (None, "confirmed"):
        raise InputError(f'{where}: units is {units!r}; only "confirmed" is known, the keys state the units')
    if units is None:
        _require_units(values, where)
    try:
        return Scanner(sigma={KEYS[k]: _number(v, f"{where}: sigma {k}") for k, v in sigma.items()}, **values)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def scanner_document(scanner: Scanner) -> dict[str, Any]:
    """The JSON object of a scanner; parameters that the paper takes as 0 are left out where they are 0."""
    document: dict[str, Any] = {
        key: getattr(scanner, name) for key, name in KEYS.items() if name in REQUIRED or getattr(scanner, name) != 0
    }
    document |= {key: getattr(scanner, name) for key, name in COUNT_KEYS.items()}
    if scanner.sigma:
        document["sigma"] = {f"{name}_{PARAMETER_UNITS[name]}": s for name, s in scanner.sigma.items()}
    document["image_rows"] = scanner.image_rows
    if scanner.certificate:
        document["certificate"] = scanner.certificate
    try:
        _require_units({name: getattr(scanner, name) for name in PARAMETER_UNITS}, "")
    except UnitError:
        document["units"] = "confirmed"
    return document


def scanner_schema() -> dict[str, Any]:
    """The JSON schema (draft 2020-12) of scanner.json, for editors and other programs."""
    number = {"type": "number"}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "tomopose scanner",
        "type": "object",
        "additionalProperties": False,
        "required": ["schema", *_required_keys()],
        "properties": {
            "schema": {"const": "tomopose/scanner/1"},
            **dict.fromkeys(KEYS, number),
            **{key: {"type": "integer", "minimum": 1} for key in COUNT_KEYS},
            "sigma": {
                "type": "object",
                "additionalProperties": False,
                "properties": {key: {"type": "number", "minimum": 0} for key in KEYS},
            },
            "image_rows": {"enum": ["top-first", "bottom-first"]},
            "certificate": {"type": "string"},
            "units": {"const": "confirmed"},
            "provenance": {"type": "object"},
        },
    }


def _required_keys() -> list[str]:
    return [*(k for k, name in KEYS.items() if name in REQUIRED), *COUNT_KEYS]


def _number(value: object, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(f"{where} is {value!r}; a number is needed")
    try:
        finite = math.isfinite(value)
    except OverflowError:  # JSON knows whole numbers of any length
        finite = False
    if not finite:
        raise InputError(f"{where} is {str(value)[:20]}, not a finite number")
    return value


def _refuse(key: str, where: str) -> None:
    """Raise the error for a key that is not known: without unit, in another unit, or unknown."""
    for good in (*KEYS, *COUNT_KEYS):
        name = good.rpartition("_")[0]
        if key == name:
            raise UnitError(f"{where}: {key!r} has no unit; write {good!r} and give it in that unit")
        if key.rpartition("_")[0] == name:
            raise UnitError(f"{where}: {key!r} is in another unit; convert it to {good!r}")
    raise InputError(f"{where}: unknown key {key!r}{unknown_column(key, KNOWN)}")


def _require_units(values: Mapping[str, float], where: str) -> None:
    for name, (low, high) in {
        "p_u": PITCH_RANGE,
        "p_v": PITCH_RANGE,
        "d_SD": DISTANCE_RANGE,
        "d_SR": (0.0, DISTANCE_RANGE[1]),
    }.items():
        value = values[name]
        if 0 < value < low or value > high:
            guess = "metres" if value < low else "micrometres"
            raise UnitError(f"{where}: {name}_mm is {value:g}; is it in {guess}? Convert it to mm; {IF_RIGHT}")
    for name in ("eta", "theta", "phi", "axis_tilt_x", "axis_tilt_y"):
        value = values.get(name, 0.0)
        off = value - np.pi / 2 * round(value / (np.pi / 2)) if name == "eta" and abs(value) < 4 else value
        if abs(off) > LARGEST_ROLL:
            raise UnitError(
                f"{where}: {name}_rad is {value:g}, which would be {math.degrees(value):.4g} deg; is it in degrees? "
                f"Convert it to rad; {IF_RIGHT}"
            )
