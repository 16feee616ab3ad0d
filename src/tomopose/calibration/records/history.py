"""A machine's calibrations over months: a history of one line each.

The history is a text of JSON lines, schema tomopose/history/1, which grows by whole lines.  A line holds the
parameters with their uncertainties and what must agree before two runs can be compared: scanner values, pivot, machine;
and a digest of the observed centres, by which a run that is added twice is known.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from tomopose.calibration.records.setup import held_scanner, observed_digest
from tomopose.calibration.result import Calibration
from tomopose.errors import FileError, InputError, SchemaVersionError
from tomopose.files import write_text
from tomopose.reading import parse_json, read_text, reader
from tomopose.values import require_types

SCHEMA = "tomopose/history/1"

Entry = Mapping[str, Any]
"""A line of the history: an object of JSON, which older and newer versions write with fewer or more members."""


def history_entry(calibration: Calibration, *, label: str = "", machine: str = "") -> dict[str, Any]:
    """What the history keeps of a calibration.

    label: a word by which to find it again;  machine: which scanner and manipulator, where one file could mix them.
    """
    made = calibration.provenance
    return {
        "schema": SCHEMA,
        "time_utc": (made.time_utc if made else "") or datetime.now(UTC).isoformat(timespec="seconds"),
        "label": label,
        "machine": machine,
        "parameters": {p.name: {"value": p.value, "u": p.u, "unit": p.unit} for p in calibration.parameters},
        "d_rms_px": calibration.d_rms,
        "chi2_dof": calibration.chi2_dof,
        "n_poses": len(calibration.pose_id),
        "n_outliers": len(calibration.outliers),
        "verdict": calibration.verdict,
        "model": calibration.model,
        "scanner": held_scanner(calibration),
        "pivot_mm": None if calibration.pivot is None else np.asarray(calibration.pivot).tolist(),
        "digest": observed_digest(calibration),
        "inputs": dict(made.inputs) if made else {},
    }


@reader("history")
def read_history(path: str | Path) -> list[dict[str, object]]:
    """All entries, in the order written.  FileError or SchemaVersionError names the line."""
    path = Path(path)
    entries = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip():
            continue
        entry = parse_json(line, f"{path}, line {number}", constants=True)
        if not isinstance(entry, dict) or entry.get("schema") != SCHEMA:
            raise SchemaVersionError(f"{path}, line {number}: schema is not {SCHEMA}", path=path)
        if not isinstance(entry.get("parameters"), dict):
            raise FileError(f"{path}, line {number}: 'parameters' is missing", path=path)
        entries.append(entry)
    return entries


def name_of(entry: Entry) -> str:
    """How people name a run: its label, or its time."""
    return str(entry.get("label") or entry.get("time_utc") or "a run without label and time")


def with_entry(entries: Sequence[Entry], entry: Entry) -> list[Entry]:
    """The history with one run more.

    InputError where the run is in the history already, or where another machine's history would be mixed with it.
    """
    for k, known in enumerate(entries, start=1):
        same = known.get("digest") == entry["digest"] or known["parameters"] == entry["parameters"]
        if same:
            raise InputError(
                f"this calibration is in the history already, as line {k} ({name_of(known)}): one run counted twice "
                "would make the machine look steadier than it is; add calibrations of new radiographs"
            )
        if known.get("machine") and entry["machine"] and known["machine"] != entry["machine"]:
            raise InputError(
                f"the history is that of machine {known['machine']!r}, and the calibration is one of "
                f"{entry['machine']!r}; keep one history file for each machine"
            )
    return [*entries, entry]


def write_history(path: str | Path, entries: Sequence[Entry]) -> None:
    """Write the whole history, atomically."""
    write_text(Path(path), "".join(json.dumps(e, ensure_ascii=False, allow_nan=True) + "\n" for e in entries))


@require_types
def append_history(
    path: str | Path, calibration: Calibration, *, label: str = "", machine: str = ""
) -> list[dict[str, object]]:
    """Add a calibration to the history file (made where absent), atomically; returns all entries.

    InputError, and nothing is written, where the same run is there already or the machine is another.
    """
    path = Path(path)
    entries = read_history(path) if path.exists() else []
    entry = history_entry(calibration, label=label, machine=machine)
    write_history(path, with_entry(entries, entry))
    return [*entries, entry]
