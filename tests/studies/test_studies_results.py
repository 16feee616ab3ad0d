"""The studies' own arithmetic on cases that need no radiographs, and their files and command line."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import typer

from tomopose.cli.study import register
from tomopose.errors import EngineMissingError, FileError, InputError
from tomopose.geometry.projection import project_ball
from tomopose.observations import BallObservations
from tomopose.studies import figure8, improvements, table1, table2
from tomopose.studies.parts import hexapod_runs, virtual_hexapod
from tomopose.studies.parts.radiographs import (
    Measured,
    errors_of,
    exact_rms,
    measure_run,
    read_out_windows,
    solve_as_paper,
)
from tomopose.studies.parts.result import StudyCheck
from tomopose.studies.parts.steps import Steps
from tomopose.studies.parts.writing import write_study
from tomopose.studies.registry import PAPER, run_study


def silent(done: int, total: int) -> None:
    pass


def measured_from_truth(run, seed: int, ellipse_px: float = 0.0209, best_px: float = 0.0005) -> Measured:
    rng = np.random.default_rng(seed)
    noisy = [run.x_D + rng.normal(scale=s / np.sqrt(2), size=run.x_D.shape) for s in (ellipse_px, best_px)]
    return Measured(
        by_ellipse=noisy[0], best=BallObservations.from_sigma(noisy[1], best_px / np.sqrt(2), pose_id=run.poses.pose_id)
    )


def test_unknown_names_and_scales_are_refused():
    with pytest.raises(InputError, match="unknown study 'table9'; known are table1"):
        run_study("table9")
    with pytest.raises(InputError, match="unknown scale 'tiny'"):
        run_study("tuy", scale="tiny")


def test_every_study_names_itself():
    import importlib

    for name in PAPER:
        module = importlib.import_module(f"tomopose.studies.{name}")
        assert module.TITLE
        assert module.QUESTION.endswith("?")
        assert module.NOTES


@pytest.mark.slow
def test_radiographs_are_measured_both_ways_and_resumed(tmp_path):
    run = table1.ball_run(2.7, 2, 7)
    run = replace(run, poses=run.poses.select([0, 20]), T_MH=run.T_MH[[0, 20]])
    steps = Steps(folder=tmp_path)
    measured = measure_run(run, steps, "two", silent)
    assert np.linalg.norm(measured.by_ellipse - run.x_D, axis=1).max() < 0.08
    assert exact_rms(run, measured.best) < 0.003
    again = measure_run(run, steps, "two", lambda done, total: None)
    assert np.array_equal(again.by_ellipse, measured.by_ellipse)
    assert np.array_equal(again.best.x_D, measured.best.x_D)


def test_windows_hold_the_ball_in_their_middle():
    run = table1.ball_run(2.7, 2, 7)
    run = replace(run, poses=run.poses.select([3]), T_MH=run.T_MH[[3]])
    ((origin, window),) = read_out_windows(run)
    x = project_ball(window.scanner, T_HT=run.T_HT, T_MH=run.T_MH, t=run.t)[0]
    np.testing.assert_allclose(x + origin, run.x_D[0], atol=1e-9)
    n_v, n_u = window.scanner.shape
    assert np.abs(x - [(n_u - 1) / 2, (n_v - 1) / 2]).max() <= 0.5


@pytest.mark.slow
def test_the_papers_solution_states_the_size_of_its_errors():
    run = table1.ball_run(5.3, 3, 1)
    inside = []
    for seed in range(12):
        calibration, _ = solve_as_paper(run, measured_from_truth(run, seed))
        assert calibration.d_rms == pytest.approx(0.0209, rel=0.12)
        u = dict(zip(calibration.tangent, np.sqrt(np.diag(calibration.covariance)), strict=True))
        inside += [abs(e) < 2 * u[n] for n, e in errors_of(calibration, run).items()]
    assert 0.85 < np.mean(inside) <= 1.0


def test_nearly_exact_centres_give_the_mount_as_nearly():
    run = table1.ball_run(5.3, 2, 1)
    calibration, _ = solve_as_paper(run, measured_from_truth(run, 2, ellipse_px=1e-5))
    assert max(abs(e) for e in errors_of(calibration, run).values()) < 1e-5


def test_table1_rows_are_beside_their_printed_numbers():
    case = table1.Case(magnification=5.3, n=2)
    content = {
        side: {
            "d_rms_opt": 0.02,
            "d_rms_exact": 0.021,
            "errors": dict.fromkeys(table1.NAMES, 1e-3),
            "u": dict.fromkeys(table1.NAMES, 2e-3),
        }
        for side in ("paper_method", "by_edges", "best")
    }
    content["chi2_9"] = {"printed": 1.1, "paper_method": 0.9, "by_edges": 2.0}
    rows = table1.rows_of(case, content)
    assert len(rows) == 12
    assert {r.source for r in rows} == {"table 1, row 4"}
    by_name = {r.quantity: r for r in rows}
    assert by_name["error of t_HT_x"].printed == 1.18
    assert by_name["error of t_HT_x"].best == pytest.approx(1.0)  # um
    assert by_name["error of w_HT_y"].paper_method == pytest.approx(1e3)  # urad
    assert not all(c.holds for c in table1.checks_of(rows))


def test_the_gain_is_held_against_the_printed_errors_of_one_unit():
    case = table1.Case(magnification=5.3, n=2)
    side = {"d_rms_opt": 0.02, "d_rms_exact": 0.0002, "errors": dict.fromkeys(table1.NAMES, 1e-7),
            "u": dict.fromkeys(table1.NAMES, 1e-7)}  # fmt: skip
    worse = {**side, "errors": dict.fromkeys(table1.NAMES, 1e-3)}
    chi2 = {"printed": 1.0, "paper_method": 1.0, "by_edges": 1.0}
    rows = table1.rows_of(case, {"paper_method": worse, "by_edges": worse, "best": side, "chi2_9": chi2})
    printed = np.array(table1.PRINTED[5.3, 2])
    px, um, urad = (table1.gain_check(rows, unit) for unit in ("px", "um", "urad"))
    assert px.found == f"{printed[1] / 0.0002:.3g} times"
    assert um.found == f"{np.sqrt(np.mean(printed[[2, 3, 4, 8, 9, 10]] ** 2)) / 1e-4:.3g} times"
    assert urad.found == f"{np.sqrt(np.mean(printed[5:8] ** 2)) / 0.1:.3g} times"
    # what is small beside our own substitute alone is no gain
    assert not table1.gain_check(table1.rows_of(case, {
        "paper_method": {**side, "errors": dict.fromkeys(table1.NAMES, 1.0)}, "by_edges": worse, "best": worse,
        "chi2_9": chi2,
    }), "um").holds  # fmt: skip


def test_independent_errors_of_the_centres_give_the_structure_that_the_covariance_says():
    case = table1.Case(magnification=5.3, n=2)
    values = []
    for seed in range(12):
        run = table1.ball_run(5.3, 2, seed)
        fitted, _ = table1.as_printed(case, run, seed)
        order = [fitted.tangent.index(name) for name in table1.NAMES]
        errors = np.array([errors_of(fitted, run)[n] for n in table1.NAMES])
        C = fitted.covariance[np.ix_(order, order)]
        values.append(table1.chi2_of(errors, C))
    assert 0.6 < np.mean(values) < 1.5


def test_the_repeat_at_90_degrees_has_the_residuals_of_y_about_x():
    c = figure8.repeat_at_90(2, 2023)
    assert c["x"] > 4 * max(c["none"], c["y"], c["z"])
    assert 0.7 < c["x"] < 1.2


@pytest.mark.slow
def test_the_virtual_hexapod_leaves_the_printed_residuals(monkeypatch):
    def from_truth(run, steps, name, progress):
        return measured_from_truth(run, 3)

    monkeypatch.setattr(hexapod_runs, "measure_run", from_truth)
    low, high = table2.EXPECTED[5.3]
    runs = tuple(hexapod_runs.solve_run(5.3, 3, 2023, k, Steps(), silent) for k in (1, 2))
    rows = table2.rows_of(5.3, runs)
    assert all(low <= s.paper_method.d_rms <= high for s in runs)
    assert all(s.best.d_rms <= 1.3 * s.floor for s in runs)
    assert all(c.holds for c in table2.checks_of(5.3, runs, rows))
    by_axis = figure8.rms_by_axis(runs[0].paper_method.d, runs[0].run.poses)
    assert by_axis["y"] > 4 * max(by_axis["none"], by_axis["x"], by_axis["z"])


def test_a_tilt_about_y_shifts_the_ball_sideways_by_the_lever():
    from tomopose import PoseSequence

    poses = PoseSequence.from_table(np.zeros((2, 3)), [[0.0, 5.0, 0.0], [5.0, 0.0, 0.0]])
    shift = virtual_hexapod.real_T_MH(poses, 5.3).t
    expected = 150.0 * np.sin(np.radians(5.0)) * virtual_hexapod.TURNED_AXES[2]
    assert abs(shift[0, 1]) == pytest.approx(expected, rel=0.01)
    assert abs(shift[1, 0]) == pytest.approx(expected, rel=0.03)
    assert abs(shift[1, 1]) < 0.1 * expected


@pytest.fixture(scope="module")
def tuy():
    return run_study("tuy")


@pytest.mark.slow
def test_source_paths_and_completeness_hold(tmp_path, tuy):
    for result in (run_study("figure9", folder=tmp_path), tuy):
        assert result.holds, [c for c in result.checks if not c.holds]
    assert tuy.row("M 5.3, multi-feature specimen", "3D scan, smallest share").best == 1.0
    with pytest.raises(InputError, match="has no row"):
        tuy.row("M 5.3", "nothing")


def test_turning_the_table_helps():
    row = improvements.table_row()
    assert row.best < 0.8 * row.paper_method


@pytest.mark.slow
def test_error_correction_helps_where_the_machine_errs():
    found = improvements.solve_case("error correction, 189 mixed poses at four table angles", 11)
    assert found["best"] < found["rigid"] / 5
    assert found["best"] < 3 * found["u"]


@pytest.mark.slow
def test_a_source_and_detector_that_move_are_corrected_too():
    found = improvements.solve_case("C-arm, 100 views, two balls of known distance", 5)
    assert found["best"] < found["rigid"] / 5
    assert found["best"] < 3 * found["u"]


@pytest.mark.slow
def test_files_are_written_once(tmp_path, tuy):
    write_study(tmp_path, tuy)
    content = json.loads((tmp_path / "study.json").read_text())
    assert content["schema"] == "tomopose/study/1"
    assert content["rows"][0]["best"] == tuy.rows[0].best
    html = (tmp_path / "study.html").read_text()
    assert tuy.title in html
    assert "http://" not in html.replace("http://www.w3.org", "")[:2000]
    assert len(list(tmp_path.glob("*.png"))) == len(tuy.figures)
    assert all(p.read_bytes().startswith(b"\x89PNG") for p in tmp_path.glob("*.png"))
    with pytest.raises(FileError, match="exists already"):
        write_study(tmp_path, tuy)


@pytest.mark.slow
def test_pages_say_what_does_not_hold(tmp_path, tuy):
    failed = StudyCheck(statement="the moon is made of cheese", found="rock", holds=False)
    write_study(tmp_path, replace(tuy, checks=(*tuy.checks, failed)))
    assert "the moon is made of cheese: rock" in (tmp_path / "study.html").read_text()


def test_without_matplotlib_page_and_numbers_are_there(tmp_path, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(EngineMissingError) as error:
        write_study(tmp_path, run_study("figure9"))
    assert error.value.install_line == "pip install matplotlib"
    assert (tmp_path / "study.html").exists()


def call(*words: str) -> int:
    app = typer.Typer()
    app.callback()(lambda: None)
    register(app)
    return typer.main.get_command(app).main(args=list(words), standalone_mode=False) or 0


@pytest.mark.slow
def test_the_command_line_runs_a_study(tmp_path, capsys):
    assert call("study", "figure9", "--out", str(tmp_path / "out"), "--json") == 0
    said = json.loads(capsys.readouterr().out)
    assert said["name"] == "figure9"
    assert said["holds"] is True
    with pytest.raises(FileError, match="exists already"):
        call("study", "figure9", "--out", str(tmp_path / "out"), "--quiet")
    assert call("study", "figure9", "--out", str(tmp_path / "out"), "--quiet", "--force") == 0
    assert capsys.readouterr().out == ""


def test_the_command_line_lists_the_studies(capsys):
    call("study", "--list")
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == list(PAPER)
