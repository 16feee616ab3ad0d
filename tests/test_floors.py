"""The house's contracts: imports only go down, foreign packages stay in their rooms, nothing heavy at the door."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

SOURCE = Path(__file__).resolve().parents[1] / "src" / "tomopose"

# A foreign package and the only folders or files that may import it.
ROOMS = {
    "plotly": ("report", "studies"),
    "matplotlib": ("report", "studies"),
    "cmcrameri": ("report", "studies", "measurement"),
    "astra": ("engines",),
    "itk": ("engines",),
    "starlette": ("review",),
    "uvicorn": ("review",),
    "typer": ("cli",),
    "rich": ("cli",),
    "click": ("cli",),
}


def imports(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            found.add(node.module.split(".")[0])
    return found


@pytest.mark.slow
@pytest.mark.parametrize("package", ROOMS)
def test_foreign_packages_stay_in_their_rooms(package):
    strays = [
        str(path.relative_to(SOURCE))
        for path in SOURCE.rglob("*.py")
        if package in imports(path) and path.relative_to(SOURCE).parts[0] not in ROOMS[package]
    ]
    assert strays == []


@pytest.mark.slow
def test_the_library_neither_prints_nor_exits():
    strays = []
    for path in SOURCE.rglob("*.py"):
        if path.relative_to(SOURCE).parts[0] == "cli":
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call):
                name = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
                owner = getattr(getattr(node.func, "value", None), "id", "")
                if (name == "print" and isinstance(node.func, ast.Name)) or (owner, name) == ("sys", "exit"):
                    strays.append(f"{path.relative_to(SOURCE)}:{node.lineno}")
    assert strays == []


def test_nothing_heavy_at_the_door():
    """`import tomopose` brings in no library at all; what is heavy comes when it is first used."""
    heavy = ("numpy", "scipy", "numba", "plotly", "h5py", "tifffile", "pydantic", "dask", "itk", "vtk")
    code = f"import sys, tomopose; print([m for m in {heavy!r} if m in sys.modules])"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert shown.strip() == "[]"


def test_help_brings_in_no_numerics():
    heavy = ("numpy", "scipy", "numba", "plotly", "h5py", "tifffile")
    code = (
        "import sys; from tomopose.cli.main import run; run(['--help']); "
        f"print([m for m in {heavy!r} if m in sys.modules], file=sys.stderr)"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "calibrate" in shown.stdout
    assert shown.stderr.strip() == "[]"
