"""docs/paper-in-code.md: each equation, table and figure appears there once, and what it names exists."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest

PAGE = Path(__file__).resolve().parents[2] / "docs" / "paper-in-code.md"
WITHOUT_CODE = ("not implemented yet", "illustration only")

EXPECTED = (
    *(f"Eq. ({k})" for k in range(1, 12)),
    "Sec. 3, inverse of (1)",
    "Sec. 3, T_TW",
    "Sec. 3, scan angles",
    "Sec. 3, initial state",
    "Sec. 4, parameter vector",
    "Sec. 6.1, sine tilt",
    "Appendix, R_x",
    "Appendix, R_y",
    "Appendix, R_z",
    "Appendix, R",
    "Appendix, angles",
    *(f"Table {k}" for k in range(1, 4)),
    *(f"Fig. {k}" for k in range(1, 17)),
    *(f"Ref. [{k}]" for k in (8, 21, 22)),
)


def rows() -> list[tuple[str, str]]:
    """(paper, code) of every row of the page's tables."""
    found = []
    for line in PAGE.read_text(encoding="utf-8").splitlines():
        cells = [c.strip() for c in line.strip("|").split("|")]
        if line.startswith("|") and len(cells) == 3 and cells[0] != "paper" and not set(cells[0]) <= set("-"):
            found.append((cells[0], cells[2]))
    return found


def resolve(name: str) -> object:
    """The object of a dotted name: the longest importable module, then attributes."""
    parts = name.split(".")
    for k in range(len(parts), 0, -1):
        try:
            value: object = importlib.import_module(".".join(parts[:k]))
        except ModuleNotFoundError as error:
            if not str(error.name).startswith("tomopose"):
                raise
            continue
        for part in parts[k:]:
            value = getattr(value, part)
        return value
    raise ModuleNotFoundError(name)


def test_each_item_of_the_paper_appears_there_exactly_once():
    assert [paper for paper, _ in rows()] == list(EXPECTED)


@pytest.mark.parametrize(("paper", "code"), rows(), ids=[p for p, _ in rows()])
def test_what_a_row_names_exists(paper, code):
    names = re.findall(r"`(tomopose\.[\w.]+)`", code)
    assert names or code.startswith(WITHOUT_CODE), f"{paper}: neither a name nor a plain word about its absence"
    for name in names:
        resolve(name)


def test_a_wrong_name_is_noticed():
    for name in ("tomopose.geometry.no_such_page", "tomopose.geometry.scanner.Scanner.no_such_thing"):
        with pytest.raises((ModuleNotFoundError, AttributeError)):
            resolve(name)
