"""Text, JSON and TOML from a file: sizes, depth and digits have limits, and a key that returns is refused."""

from __future__ import annotations

import json
import math
import re
import tomllib
from pathlib import Path
from typing import Any

from tomopose.errors import FileError, InputError
from tomopose.reading.memory import require_memory

DEEPEST = 64
"""Levels of objects and lists; the deepest file of this package has 7, a glTF or CTSimU file about 12."""
MOST_DIGITS = 308
"""Digits of one whole number: more do not fit a float, and none needs more than 17 significant ones."""
HUGE_EXPONENT = re.compile(r"[eE]\+?\d{3}|\d{300}")
MEMORY_PER_BYTE = 12
"""Bytes in memory for each byte of JSON, TOML or CSV text: about the most that lists of short numbers take."""
STREAM_BYTES = 256 * 2**20
"""The most that is read from a stream, whose length is not known beforehand."""


def read_bytes(path: Path, *, per_byte: int = 1) -> bytes:
    """A file's content; FileError where memory is too small for what becomes of it (`per_byte` bytes for each)."""
    try:
        with open(path, "rb") as stream:
            size = path.stat().st_size
            require_memory(path, "its content", size * per_byte)
            content = stream.read(max(size, STREAM_BYTES) + 1)
    except FileNotFoundError as error:
        raise FileError(f"{path} does not exist", path=path) from error
    except OSError as error:
        raise FileError(f"{path} cannot be read: {error.strerror or error}", path=path) from error
    if len(content) > max(size, STREAM_BYTES):
        raise FileError(f"{path} grows while it is read, or does not end", path=path)
    return content


def read_text(path: str | Path) -> str:
    """The text of a UTF-8 file without its byte order mark, lines ended by \\n; FileError where it cannot be read."""
    path = Path(path)
    raw = read_bytes(path, per_byte=MEMORY_PER_BYTE)
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise FileError(f"{path} is UTF-16 text; save it as UTF-8 (in a spreadsheet: CSV UTF-8)", path=path)
    try:
        return raw.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as error:
        raise FileError(f"{path} is no UTF-8 text (byte {error.start}); save it as UTF-8", path=path) from error


def parse_json(text: str, where: Path | str, *, constants: bool = False) -> Any:
    """The value in a JSON text.

    where: the file, for messages.  constants: whether NaN and Infinity, which are no JSON, may occur.
    FileError for a text that is no JSON, a key that returns within one object, more than 64 levels, whole numbers of
    more than 308 digits; InputError for a number that is not finite.
    """
    _require_shallow(text, where)
    odd: list[str] = []

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for key, value in pairs:
            if odd and _holds_constant(value):
                raise InputError(f"{where}: {key} is {odd[0]}, not a finite number; null says that it is not known")
            if key in found:
                raise FileError(f"{where}: the key {key[:60]!r} occurs twice in one object", path=where)
            found[key] = value
        return found

    def whole(digits: str) -> int:
        if len(digits) > MOST_DIGITS:
            raise FileError(f"{where}: a number of {len(digits)} digits ({digits[:10]}...)", path=where)
        return int(digits)

    def constant(name: str) -> float:
        if not constants:
            odd.append(name)
        return float(name.replace("Infinity", "inf"))

    def number(digits: str) -> float:
        if math.isinf(float(digits)) and not constants:
            odd.append(digits[:20])
        return float(digits)

    try:
        hooks: dict[str, Any] = {"parse_float": number} if HUGE_EXPONENT.search(text) else {}
        document = json.loads(text, object_pairs_hook=unique, parse_int=whole, parse_constant=constant, **hooks)
    except json.JSONDecodeError as error:
        raise FileError(f"{where} is no JSON: {error}", path=where) from error
    except RecursionError as error:
        raise FileError(f"{where} is no JSON that is read here: it is nested too deeply", path=where) from error
    if odd:
        raise InputError(f"{where} holds {odd[0]}, which is no finite number")
    return document


def _holds_constant(value: object) -> bool:
    """Whether a value or a list of values holds a number that is not finite."""
    if isinstance(value, list):
        return any(map(_holds_constant, value))
    return isinstance(value, float) and not math.isfinite(value)


def parse_toml(text: str, where: Path | str) -> dict[str, Any]:
    """The table in a TOML text; FileError for a text that is no TOML, with the line, and for the limits of JSON."""
    _require_shallow(text, where)
    longest = max((len(found) for found in re.findall(r"[0-9_]{40,}", text)), default=0)
    if longest > MOST_DIGITS:
        raise FileError(f"{where}: a number of {longest} digits is no measurement", path=where)
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise FileError(f"{where} is no TOML: {error}", path=where) from error
    except (RecursionError, ValueError, OverflowError) as error:
        raise FileError(f"{where} is no TOML that is read here: {error}", path=where) from error


STRING_OR_BRACKET = re.compile(r'"(?:[^"\\]|\\.)*+"|[\[{]|[\]}]')


def _require_shallow(text: str, where: Path | str) -> None:
    """FileError for more levels of brackets than any file needs; brackets inside text do not count."""
    if text.count("[") + text.count("{") <= DEEPEST:
        return
    depth = 0
    for found in STRING_OR_BRACKET.finditer(text):
        first = found[0][0]
        depth += 1 if first in "[{" else -1 if first in "]}" else 0
        if depth > DEEPEST:
            raise FileError(
                f"{where} is nested more than {DEEPEST} levels deep (at character {found.start()})",
                path=where,
            )
