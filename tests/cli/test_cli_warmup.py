"""Kernels compiled beforehand, the note of it, and progress that says so while they are."""

from __future__ import annotations

import json
import multiprocessing
import time

import numba
import numba.core.event
import pytest

from tomopose import kernel_cache
from tomopose.cli import common
from tomopose.cli.common import Say
from tomopose.cli.main import run
from tomopose.studies import warmup


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv(kernel_cache.VARIABLE, str(tmp_path))
    return tmp_path


def compiled_anew():
    """Compiles a kernel that calls another, and no kept one."""

    @numba.njit
    def inner(x):
        return x + 1

    @numba.njit
    def outer(x):
        return inner(x) * 2

    return outer(1.5)


def test_jobs_that_are_done_are_noted_until_what_they_compiled_from_changes(folder, monkeypatch):
    assert warmup.compiled_jobs() == set()
    warmup.note_done(["detect"])
    warmup.note_done(["plan"])
    assert warmup.compiled_jobs() == {"detect", "plan"}
    monkeypatch.setattr(warmup, "_key", lambda: "of another version")
    assert warmup.compiled_jobs() == set()


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"key": 1, "jobs": 2}'])
def test_a_note_that_cannot_be_read_counts_as_none(folder, text):
    (folder / warmup.NOTE).write_text(text)
    assert warmup.compiled_jobs() == set()


def test_what_is_noted_is_not_compiled_again(folder, monkeypatch, capsys):
    warmup.note_done(warmup.JOBS)
    monkeypatch.setattr(warmup, "ProcessPoolExecutor", None)
    monkeypatch.setattr(warmup, "multiprocessing", None)
    assert run(["warmup", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"folder": str(folder), "compiled": list(warmup.JOBS)}
    with warmup.compiled_while("simulate", beside=("detect", "calibrate")):
        assert warmup.compiled_jobs() == set(warmup.JOBS)


def test_work_that_fails_does_not_wait_for_what_is_compiled_beside_it(folder, monkeypatch):
    monkeypatch.setattr(warmup, "run_jobs", time.sleep)  # waits for ever, given the jobs as seconds
    monkeypatch.setattr(warmup, "tuple", lambda missing: 3600.0, raising=False)
    with pytest.raises(KeyboardInterrupt), warmup.compiled_while("simulate", beside=("detect",)):
        raise KeyboardInterrupt
    assert warmup.compiled_jobs() == set()
    for process in multiprocessing.active_children():
        process.join(60)
    assert multiprocessing.active_children() == []


def test_doctor_says_what_is_compiled(folder, capsys):
    warmup.note_done(["simulate"])
    assert run(["doctor", "--json"]) == 0
    compiled = json.loads(capsys.readouterr().out)["compiled"]
    assert compiled == {name: name == "simulate" for name in warmup.JOBS}


def test_an_unknown_name_is_an_error_of_usage(folder, capsys):
    assert run(["warmup", "--only", "detect,paint"]) == 2
    assert "'paint'" in capsys.readouterr().err


def test_without_a_folder_to_keep_kernels_in_warmup_says_how_to_name_one(monkeypatch, capsys):
    monkeypatch.setattr(kernel_cache, "kept_in", lambda package: None)
    assert run(["warmup"]) == 0
    assert kernel_cache.VARIABLE in capsys.readouterr().out
    assert warmup.compiled_jobs() == set()
    warmup.note_done(["detect"])  # nowhere, and without an error


def test_a_kernel_that_calls_others_is_reported_once():
    said = []
    with kernel_cache.reporting_compiling(said.append):
        assert compiled_anew() == 5.0
    assert said == [True, False]
    compiled_anew()
    assert said == [True, False]


def test_progress_says_compiling_once_where_lines_are_plain(capsys):
    with Say().progress("detecting") as progress:
        progress(0, 2)
        compiled_anew()
        compiled_anew()
        progress(2, 2)
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(":")[1].split()[0] for line in lines] == ["0", "compiling", "2"]


def test_time_left_is_that_of_the_work_and_not_of_the_compiling(monkeypatch, capsys):
    now = 0.0
    monkeypatch.setattr(common.time, "monotonic", lambda: now)
    with Say().progress("detecting") as progress:
        with numba.core.event.trigger_event("numba:compile"):
            now = 60.0
        now = 62.0
        progress(1, 11)
    assert capsys.readouterr().err.splitlines()[-1] == "detecting: 1 of 11, 20 s left"


@pytest.mark.slow
@pytest.mark.parametrize("name", list(warmup.JOBS))
def test_each_job_runs_and_compiles_nothing_the_second_time(name):
    warmup.run_job(name)
    said = []
    with kernel_cache.reporting_compiling(said.append):
        warmup.run_job(name)
    assert said == []
