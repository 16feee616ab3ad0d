"""A few seeded mutants of every kind of file, and a few kills; benchmarks/fuzz holds the long job."""

from __future__ import annotations

import random
import sys
from pathlib import Path

import pytest

FUZZ = Path(__file__).resolve().parents[2] / "benchmarks" / "fuzz"


@pytest.fixture
def _fuzz_path(monkeypatch):
    monkeypatch.syspath_prepend(str(FUZZ))
    yield
    for name in ("corpus", "mutants", "run", "kills"):
        sys.modules.pop(name, None)


@pytest.mark.slow
@pytest.mark.usefixtures("_fuzz_path")
@pytest.mark.filterwarnings("ignore:.*multi-threaded.*:DeprecationWarning")
def test_mutants_are_read_or_refused_by_name():
    from run import fuzz

    groups = ("geometry", "machines", "images", "volumes", "meshes", "texts")
    count = fuzz(minutes=5, name="ci", most=12, groups=groups)
    assert count.mutants > 400
    assert count.read + count.refused == count.mutants
    assert [*count.foreign, *count.hangs, *count.crashes, *count.grown] == []


@pytest.mark.slow
@pytest.mark.usefixtures("_fuzz_path")
@pytest.mark.parametrize("name", ["exports", "results"])
def test_a_killed_writer_leaves_the_old_or_the_new_result(tmp_path, name):
    from kills import kill_once

    _, left = kill_once(name, tmp_path, random.Random(name))
    assert left in ("old", "new", "resumed")


@pytest.mark.usefixtures("_fuzz_path")
def test_kills_continue_after_the_last_whole_line_of_their_log(tmp_path):
    from kills import read_log

    log = tmp_path / "kills.jsonl"
    log.write_text('{"seed": 1, "kill": 0, "left": "old"}\n{"seed": 1, "kill": 1, "le')
    assert read_log(log) == [{"seed": 1, "kill": 0, "left": "old"}]
    assert log.read_text() == '{"seed": 1, "kill": 0, "left": "old"}\n'
    assert read_log(tmp_path / "none") == []
