"""Remarks in robot programs that say which pose follows: `pose_id NAME` and `table to X deg`, in any comment sign.

`tomopose plan --commands` writes them, so that what it wrote is read back with its ids and table angles.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from tomopose.io.foreign.number_words import NUM

POSE_ID = re.compile(r"[;!#]\s*pose_id\s+(\S.*?)\s*$")
TABLE = re.compile(rf"[;!#]\s*table to\s+({NUM})\s*deg\s*$")


@dataclass
class Remarks:
    """Collects remarks line by line; `pose` closes one pose and remembers what was said before it."""

    ids: list[str | None] = field(default_factory=list)
    alphas: list[str | None] = field(default_factory=list)
    next_id: str | None = None
    alpha: str | None = None

    def line(self, text: str) -> None:
        """A line that may be a remark."""
        if found := POSE_ID.search(text):
            self.next_id = found[1]
        if found := TABLE.search(text):
            self.alpha = found[1]

    def pose(self) -> None:
        """A pose begins here."""
        self.ids.append(self.next_id)
        self.alphas.append(self.alpha)
        self.next_id = None

    def columns(self) -> dict[str, tuple[str, ...]]:
        """`pose_id` and `alpha`, each only where every pose has one (and an angle differs from 0)."""
        out: dict[str, tuple[str, ...]] = {}
        ids = [i for i in self.ids if i is not None]
        if ids and len(ids) == len(self.ids) and len(set(ids)) == len(ids):
            out["pose_id"] = tuple(ids)
        alphas = [a for a in self.alphas if a is not None]
        if alphas and len(alphas) == len(self.alphas) and any(float(a) != 0 for a in alphas):
            out["alpha"] = tuple(alphas)
        return out
