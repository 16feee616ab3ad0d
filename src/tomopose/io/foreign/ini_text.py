"""`key = value` text with [sections], as scanners write it: keys in any case, values up to the end of the line."""

from __future__ import annotations

import re
from collections.abc import Mapping

from tomopose.errors import InputError
from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.number_words import NUM

SECTION = re.compile(r"^\s*\[(?P<name>[^\]]*)\]\s*$")
ENTRY = re.compile(r"^\s*(?P<key>[^=:\[\]#;<>][^=:<>]*?)\s*[=:]\s*(?P<value>.*?)\s*$")
LEADING_NUMBER = re.compile(rf"\s*({NUM})")


class IniText:
    """Sections of a text.  `number` reads a value, with a decimal comma as with a point; None where it is missing."""

    def __init__(self, file: ForeignFile) -> None:
        self.path = file.path
        self.sections: dict[str, dict[str, str]] = {}
        section = ""
        for line in file.lines:
            if found := SECTION.match(line):
                section = found["name"].strip().lower()
            elif (found := ENTRY.match(line)) and not line.lstrip().startswith(("#", ";", "//")):
                self.sections.setdefault(section, {})[found["key"].strip().lower()] = found["value"]

    def word(self, key: str, *sections: str) -> str | None:
        """The value of a key, looked for in those sections, or in all."""
        for name in sections or tuple(self.sections):
            value = self.sections.get(name.lower(), {}).get(key.lower())
            if value is not None and value != "":
                return value
        return None

    def number(self, key: str, *sections: str) -> float | None:
        """The value as a number; InputError where it is there and is not a number."""
        word = self.word(key, *sections)
        if word is None:
            return None
        found = LEADING_NUMBER.match(re.sub(r"(?<=\d),(?=\d)", ".", word))
        if not found:
            raise InputError(f"{self.path}: {key} is {word[:40]!r}; a number is needed")
        return float(found[1])

    def said(self, *keys: str) -> tuple[str, ...]:
        """`key = value` of the keys that are there and not 0, for the list of what is not used."""
        words = {k: self.word(k) for k in keys}
        return tuple(f"{k} = {w}" for k, w in words.items() if w is not None and not _is_zero(w))


def _is_zero(word: str) -> bool:
    try:
        return float(word.replace(",", ".")) == 0
    except ValueError:
        return False


def present(values: Mapping[str, float | None]) -> int:
    """How many of the values are there."""
    return sum(v is not None for v in values.values())
