"""Numbers as they are written: kept digit by digit, scaled exactly, so that a table holds what the file said."""

from __future__ import annotations

import re
from decimal import Decimal, InvalidOperation

from tomopose.errors import InputError
from tomopose.io.table_text import NUMBER, NUMPY_REPR

NUM = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
"""A number inside a larger pattern."""
UNIT_FACTORS = {
    "mm": "1",
    "m": "1000",
    "cm": "10",
    "um": "0.001",
    "µm": "0.001",
    "μm": "0.001",
    "nm": "0.000001",
    "in": "25.4",
    "inch": "25.4",
}
"""mm in one unit of length, as a decimal."""


def number_word(word: str, where: str) -> str:
    """A number as Python writes it; InputError names the place of a word that is no finite number."""
    written = NUMPY_REPR.fullmatch(word.strip())
    word = written["number"] if written else word.strip()
    if not NUMBER.fullmatch(word):
        raise InputError(f"{where}: {word[:40]!r} is not a finite number")
    return word


def scaled(word: str, factor: str) -> str:
    """A decimal number times a decimal factor, exact: '0.7954525' m is '795.4525' mm."""
    if factor == "1":
        return word
    try:
        value = Decimal(word) * Decimal(factor)
    except InvalidOperation as error:
        raise InputError(f"{word[:40]!r} is not a number") from error
    text = format(value.normalize(), "f")
    return text if len(text) < 40 else repr(float(value))


def mm_words(words: tuple[str, ...], unit: str) -> tuple[str, ...]:
    """Lengths of a unit in mm; InputError for a unit that is not known."""
    if unit not in UNIT_FACTORS:
        raise InputError(f"unknown unit of length {unit!r}; known are {', '.join(UNIT_FACTORS)}")
    return tuple(scaled(word, UNIT_FACTORS[unit]) for word in words)


def pairs_of(text: str, separator: str = r"[\s=:]\s*") -> dict[str, str]:
    """`X 1.0, Y=2` as {"X": "1.0", "Y": "2"}: names in capitals with their numbers."""
    found = re.findall(rf"\b([A-Za-z_]\w*)\s*{separator}\s*({NUM})", text)
    return {name.upper(): value for name, value in found}
