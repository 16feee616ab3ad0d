"""The measurable part of the house's style: folders, functions, nesting, circles, and parameters that say nothing."""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

SOURCE = Path(__file__).resolve().parents[1] / "src" / "tomopose"
FILES = sorted(SOURCE.rglob("*.py"))

MOST_FILES, MOST_LINES, MOST_PARAMETERS, DEEPEST = 12, 80, 12, 4
MOST_ANY = 150
"""The number may only fall."""
ANY_BECAUSE = {
    "content of a file that others write (JSON, TOML, tags, arrays by name): each entry is checked as it is read": (
        "exports/", "files.py", "io/", "manipulator/", "measurement/mesh/step.py", "provenance.py", "reading/text.py",
        "simulation/scene/", "studies/",
    ),
    "objects of a package without types, or of several that do the same work": (
        "cli/", "detection/run/", "measurement/surface/contour.py", "reconstruction/", "report/",
        "simulation/projector/gvxr.py",
    ),
    "columns or options that are handed on whole to a function which types them": (
        "measurement/surface/surface.py", "observations.py", "simulation/detector/detector.py", "simulation/run.py",
        "uncertainty/virtual_scans.py",
    ),
    "rows by number, mask or slice; one value or a sequence of them": ("calibration/", "planning/"),
    "the ground floor names no type of the rooms above": ("errors.py",),
}  # fmt: skip
"""Why a parameter is typed Any -> the files where it may be."""

ONE_FILE_A_THING = ("cli", "exports", "io/foreign")
"""Folders where a file is one verb, one format or one vendor: they may be longer."""

COMPILED = 14
"""Parameters that a compiled kernel may have: NumPy arrays that numba cannot take as one value without a copy."""

BLOCKS = (ast.If, ast.For, ast.While, ast.With, ast.Try, ast.Match)
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


def functions() -> Iterator[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef]]:
    """("file:name", definition) of every function, methods and inner ones too."""
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, FUNCTIONS):
                yield f"{path.relative_to(SOURCE)}:{node.name}", node


def parameters(node: ast.FunctionDef | ast.AsyncFunctionDef) -> list[ast.arg]:
    a = node.args
    return [*a.posonlyargs, *a.args, *a.kwonlyargs, *filter(None, [a.vararg, a.kwarg])]


def is_compiled(node: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    return any("njit" in ast.unparse(d) or "vectorize" in ast.unparse(d) for d in node.decorator_list)


def depth(node: ast.AST, level: int = 0) -> int:
    """Deepest nesting of blocks; an elif does not nest, nor do functions inside."""
    deepest = level
    for child in ast.iter_child_nodes(node):
        if isinstance(child, (*FUNCTIONS, ast.ClassDef, ast.Lambda)):
            continue
        is_elif = isinstance(node, ast.If) and isinstance(child, ast.If) and node.orelse == [child]
        inner = level + (isinstance(child, BLOCKS) and not is_elif)
        deepest = max(deepest, depth(child, inner))
    return deepest


def test_a_folder_is_a_room_not_a_hall():
    files = Counter(str(p.parent.relative_to(SOURCE)) for p in FILES if p.name != "__init__.py")
    assert {f: n for f, n in files.items() if n > MOST_FILES and f not in ONE_FILE_A_THING} == {}


@pytest.mark.slow
def test_a_function_is_read_on_one_screen():
    long = {name: f.end_lineno - f.lineno + 1 for name, f in functions() if f.end_lineno - f.lineno >= MOST_LINES}
    assert long == {}


@pytest.mark.slow
def test_a_function_takes_few_arguments():
    counts = {name: (len(parameters(f)), COMPILED if is_compiled(f) else MOST_PARAMETERS) for name, f in functions()}
    assert {name: n for name, (n, most) in counts.items() if n > most} == {}


@pytest.mark.slow
def test_blocks_nest_four_deep_at_most():
    deep = {name: depth(f) for name, f in functions() if depth(f) > DEEPEST}
    assert deep == {}


@pytest.mark.slow
def test_few_parameters_are_typed_any():
    said_nothing = [
        f"{name}({a.arg})"
        for name, f in functions()
        for a in parameters(f)
        if a.annotation is not None and any(isinstance(n, ast.Name) and n.id == "Any" for n in ast.walk(a.annotation))
    ]
    without_reason = [n for n in said_nothing if not n.startswith(tuple(f for fs in ANY_BECAUSE.values() for f in fs))]
    assert without_reason == []
    assert len(said_nothing) < MOST_ANY, Counter(n.split(":")[0] for n in said_nothing).most_common(20)


def module_name(path: Path) -> str:
    parts = path.relative_to(SOURCE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported(path: Path, known: set[str]) -> set[str]:
    """Modules of this package that a file imports anywhere, for types too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            below = {f"{node.module}.{a.name}" for a in node.names} & known
            found |= below or ({node.module} & known)
        elif isinstance(node, ast.Import):
            found |= {a.name for a in node.names} & known
    return found - {module_name(path)}


@pytest.mark.slow
def test_no_files_import_one_another_in_a_circle():
    names = {module_name(p): p for p in FILES}
    graph = {name: imported(path, set(names)) for name, path in names.items()}
    # the public face names everything and is imported by the front door alone
    graph["tomopose"] = set()
    left = dict(graph)
    while free := [n for n, uses in left.items() if not uses & left.keys()]:
        for name in free:
            del left[name]
    # what remains is on a circle, or above one
    on_circle = sorted(n for n in left if any(n in left[m] for m in left))
    assert on_circle == []


@pytest.mark.parametrize(
    ("code", "deep"),
    [
        ("def f():\n if a:\n  pass\n elif b:\n  pass\n else:\n  pass", 1),
        ("def f():\n for x in y:\n  with z:\n   try:\n    if w:\n     pass\n   finally:\n    pass", 4),
        ("def f():\n def g():\n  if a:\n   if b:\n    pass", 0),
    ],
)
def test_nesting_is_counted_as_a_reader_counts_it(code, deep):
    assert depth(ast.parse(code).body[0]) == deep
