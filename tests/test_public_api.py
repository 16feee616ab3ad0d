"""The public surface: flat, sorted, importable, documented."""

from __future__ import annotations

import inspect

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


@pytest.mark.parametrize("name", tomopose.__all__)
def test_every_public_name_is_there_and_documented(name):
    thing = getattr(tomopose, name)
    assert inspect.getdoc(thing), f"{name} has no docstring"
    assert thing.__module__.startswith("tomopose.")


def test_unknown_names_are_attribute_errors():
    with pytest.raises(AttributeError, match="no attribute 'calibrat'"):
        tomopose.calibrat  # noqa: B018


def test_dir_lists_the_public_names():
    assert set(tomopose.__all__) <= set(dir(tomopose))
    assert tomopose.__version__[0].isdigit()
