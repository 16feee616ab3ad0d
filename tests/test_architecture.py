"""docs/architecture.md shows the import contracts of pyproject.toml, and nothing else.

Run as a program, this file writes the drawing anew: python tests/test_architecture.py
"""

from __future__ import annotations

import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "architecture.md"
BEGIN, END = "<!-- drawn from pyproject.toml -->\n", "<!-- end of the drawing -->\n"


def drawing() -> str:
    """Every contract of layers as a text figure, the highest floor first."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    parts = []
    for contract in contracts:
        if contract["type"] == "layers":
            floors = "\n".join(f"  {floor}" for floor in contract["layers"])
            where = ", ".join(contract.get("containers", ()))
            parts.append(f"## {contract['name']}\n\n```text\n{where}\n{floors}\n```\n")
        else:
            kept = ", ".join(f"`{name}`" for name in contract["forbidden_modules"])
            parts.append(f"## {contract['name']}\n\n{kept} may be imported nowhere else.\n")
    return "\n".join(parts)


def test_the_page_shows_the_contracts():
    text = PAGE.read_text(encoding="utf-8")
    shown = text[text.index(BEGIN) + len(BEGIN) : text.index(END)]
    assert shown == drawing(), "run python tests/test_architecture.py"


def test_every_room_of_the_calibration_has_its_floor():
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    (own,) = (c for c in contracts if c.get("containers") == ["tomopose.calibration"])
    named = {room.strip() for floor in own["layers"] for room in floor.split("|")}
    folder = ROOT / "src" / "tomopose" / "calibration"
    there = {p.stem for p in folder.glob("*.py") if p.stem != "__init__"}
    there |= {p.name for p in folder.iterdir() if (p / "__init__.py").exists()}
    assert named == there


if __name__ == "__main__":
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(text[: text.index(BEGIN) + len(BEGIN)] + drawing() + text[text.index(END) :], encoding="utf-8")
