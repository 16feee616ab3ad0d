"""Kept steps: an interrupted study continues with the same numbers, and never with another study's."""

from __future__ import annotations

import numpy as np
import pytest

from tomopose.kept import StartsAnewWarning
from tomopose.studies.parts.steps import Steps, sources


def test_a_kept_step_is_not_computed_again_and_gives_the_same_numbers(tmp_path):
    calls = []

    def compute():
        calls.append(1)
        return {"x": np.array([0.1, 1 / 3]), "name": "a"}

    steps = Steps(folder=tmp_path, key={"seed": 1})
    first, second = steps.of("one", compute), steps.of("one", compute)
    assert len(calls) == 1
    assert first == second == {"x": [0.1, 1 / 3], "name": "a"} == Steps().of("one", compute)


def test_another_key_is_computed_anew(tmp_path):
    assert Steps(folder=tmp_path, key={"seed": 1}).of("one", lambda: {"x": 1}) == {"x": 1}
    with pytest.warns(StartsAnewWarning, match="seed was 1, now 2"):
        assert Steps(folder=tmp_path, key={"seed": 2}).of("one", lambda: {"x": 2}) == {"x": 2}
    with pytest.warns(StartsAnewWarning, match="poses is new"):
        assert Steps(folder=tmp_path, key={"seed": 2}).of("one", lambda: {"x": 3}, poses=[1.0]) == {"x": 3}
    poses = np.array([1.0, np.nextafter(1.0, 2.0)])
    with pytest.warns(StartsAnewWarning, match="poses changed"):
        assert Steps(folder=tmp_path, key={"seed": 2}).of("one", lambda: {"x": 4}, poses=poses) == {"x": 4}


def test_half_a_file_is_computed_anew(tmp_path):
    steps = Steps(folder=tmp_path)
    (tmp_path / "one.json").write_text('{"schema": "tomopose/study-step/1", "key":')
    with pytest.warns(StartsAnewWarning, match="no readable key"):
        assert steps.of("one", lambda: {"x": 4}) == {"x": 4}
    assert Steps(folder=tmp_path).of("one", lambda: {"x": 5}) == {"x": 4}


def test_a_step_of_other_code_is_computed_anew(tmp_path, monkeypatch):
    def compute():
        return {"x": 1}

    compute.__module__ = "tomopose.studies.tuy"
    assert Steps(folder=tmp_path).of("one", compute) == {"x": 1}
    monkeypatch.setattr("tomopose.studies.parts.steps.sources", lambda module: "other")
    with pytest.warns(StartsAnewWarning, match="sources"):
        assert Steps(folder=tmp_path).of("one", lambda: {"x": 2}) == {"x": 2}


def test_sources_are_those_that_a_module_imports(monkeypatch, tmp_path):
    house = tmp_path / "tomopose"
    (house / "studies").mkdir(parents=True)
    (house / "studies" / "a.py").write_text("from tomopose.studies.b import f\n")
    (house / "studies" / "b.py").write_text("from tomopose import (\n    c,\n)\n")
    (house / "c.py").write_text("x = 1\n")
    (house / "d.py").write_text("y = 1\n")
    monkeypatch.setattr("tomopose.studies.parts.steps.PACKAGE", house)

    def digest():
        sources.cache_clear()
        return sources("tomopose.studies.a")

    try:
        first = digest()
        (house / "d.py").write_text("y = 2\n")
        assert digest() == first != ""
        (house / "c.py").write_text("x = 2\n")
        assert digest() != first
        assert sources("numpy.linalg") == ""
    finally:
        sources.cache_clear()
