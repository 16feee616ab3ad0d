"""A file of unknown origin: its first bytes and, when asked for, its text."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from tomopose.reading import read_bytes, reading, require_file

HEAD_BYTES = 4096
BYTES_PER_BYTE = 20
"""Memory that a reader needs for each byte of text: the text, its lines, and numbers as words."""
UTF16 = (b"\xff\xfe", b"\xfe\xff")


@dataclass(frozen=True)
class ForeignFile:
    """A file to be recognised.  Only what a reader asks for is read; FileError where the system refuses."""

    path: Path

    @cached_property
    def head(self) -> bytes:
        """The first bytes."""
        require_file(self.path, "file")
        with reading(self.path, "file"), open(self.path, "rb") as stream:
            return stream.read(HEAD_BYTES)

    @property
    def suffix(self) -> str:
        """The name's ending in small letters, with its point."""
        return self.path.suffix.lower()

    @cached_property
    def is_text(self) -> bool:
        """Whether the first bytes can be text: no zero byte, except in UTF-16 with its mark."""
        return self.head[:2] in UTF16 or b"\0" not in self.head

    @cached_property
    def text(self) -> str:
        """The text: UTF-8, UTF-16 with its mark, or else Windows-1252, which controllers write.  "" if it is no
        text.
        """
        if not self.is_text:
            return ""
        raw = read_bytes(self.path, per_byte=BYTES_PER_BYTE)
        if raw[:2] in UTF16:
            return raw.decode("utf-16", errors="replace")
        try:
            return raw.decode("utf-8-sig")
        except UnicodeDecodeError:
            return raw.decode("cp1252", errors="replace")

    @cached_property
    def lines(self) -> list[str]:
        """The lines of the text."""
        return self.text.splitlines()
