"""The public surface: flat, sorted, importable, documented."""

from __future__ import annotations

import importlib
import inspect
import typing
from pathlib import Path

import pytest

import tomopose

FIXED = {
    "Scanner", "VoxelGrid", "calibrate", "detect", "export", "open_images", "projection_matrices", "read_calibration",
    "read_geometry", "read_matrices", "read_observations", "read_poses", "read_scanner", "reconstruct",
}  # fmt: skip
"""Names that people's scripts rest on (the published Python interface)."""


def test_all_is_flat_and_sorted():
    assert tomopose.__all__ == sorted(tomopose.__all__)
    assert not any("." in name or name.startswith("_") for name in tomopose.__all__)
    assert set(tomopose.__all__) >= FIXED


def home(thing):
    return thing.__name__ if inspect.ismodule(thing) else thing.__module__


@pytest.mark.parametrize("name", tomopose.__all__)
def test_every_public_name_is_there_and_documented(name):
    thing = getattr(tomopose, name)
    assert inspect.getdoc(thing), f"{name} has no docstring"
    assert home(thing).startswith("tomopose.")


def functions_of(name):
    """The public functions of a name: itself, or a class's fields, methods and properties."""
    thing = getattr(tomopose, name)
    if inspect.isfunction(thing):
        return [thing]
    if not inspect.isclass(thing) or issubclass(thing, BaseException):
        return []
    members = [m for k, m in vars(thing).items() if not k.startswith("_")]
    found = [getattr(m, "fget", None) or getattr(m, "func", None) or getattr(m, "__func__", m) for m in members]
    return [thing, *(f for f in found if inspect.isfunction(f))]


def named_types(hint):
    """The classes of this package that an annotation names."""
    if isinstance(hint, type) and not typing.get_args(hint):
        return {hint} if hint.__module__.startswith("tomopose.") else set()
    return set().union(*map(named_types, typing.get_args(hint)), set())


def test_every_type_that_a_public_signature_names_is_public():
    public = {id(getattr(tomopose, name)) for name in tomopose.__all__}
    hidden = {
        f"{kind.__module__}.{kind.__name__} (in {name})"
        for name in tomopose.__all__
        for function in functions_of(name)
        for hint in typing.get_type_hints(function).values()
        for kind in named_types(hint)
        if id(kind) not in public
    }
    assert hidden == set()


def test_no_attribute_of_a_package_is_both_a_module_and_a_function():
    """`tomopose.a.b` means one thing: a function never hides the module of its name."""
    root = Path(tomopose.__file__).parent
    both = []
    for face in root.rglob("__init__.py"):
        package = importlib.import_module(".".join(face.parent.relative_to(root.parent).parts))
        for name in getattr(package, "__all__", ()):
            module = face.with_name(f"{name}.py").exists() or (face.parent / name).is_dir()
            if module and not inspect.ismodule(getattr(package, name)):
                both.append(f"{package.__name__}.{name}")
    assert both == []


def test_unknown_names_are_attribute_errors():
    with pytest.raises(AttributeError, match="no attribute 'calibrat'"):
        tomopose.calibrat  # noqa: B018


def test_dir_lists_the_public_names():
    assert set(tomopose.__all__) <= set(dir(tomopose))
    assert tomopose.__version__[0].isdigit()
