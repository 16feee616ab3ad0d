"""Balls on a table that turns alone: what they determine, how well, and what they cannot say."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import tomopose as tp
from tomopose.errors import InputError, NotObservableError

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks" / "trust"))

from turntable import Table, scan_of, turntable_run


def values(cal):
    return {p.name: p for p in cal.parameters}


@pytest.fixture(scope="module")
def run():
    return turntable_run(np.random.default_rng(5))


@pytest.fixture(scope="module")
def cal(run):
    return tp.calibrate_turntable(run.scanner, run.poses, run.observations)


@pytest.mark.slow
def test_the_piercing_point_and_the_roll_are_found_from_pixels_and_half_a_degree_away(run, cal):
    found = values(cal)
    for name, limit in (("u_0", 1.0), ("v_0", 1.0), ("eta", 1e-4), ("theta", 5e-3), ("phi", 5e-3)):
        assert found[name].u < limit
        assert abs(found[name].value - run.values[name]) < 4 * found[name].u
    assert cal.arrangement == "turntable"
    assert cal.verdict == "trustworthy"
    np.testing.assert_array_equal(cal.T_HT.matrix, np.eye(4))


@pytest.mark.slow
def test_intervals_hold_the_truth_of_another_generator_and_a_scan_is_as_good_as_stated():
    """Four runs of nine values by a generator without the library's chain; benchmarks/trust/turntable.py runs sixty."""
    inside, ratio = [], []
    for seed in range(4):
        run = turntable_run(np.random.default_rng(100 + seed))
        cal = tp.calibrate_turntable(run.scanner, run.poses, run.observations, hypotheses=False)
        inside += [abs(p.value - run.values[n]) < 2.6 * p.u for n, p in values(cal).items() if n in run.values]
        error, stated = scan_of(run, cal)
        ratio.append(error / stated)
    assert np.mean(inside) > 0.9
    assert max(ratio) < 3.5


@pytest.mark.slow
def test_a_table_beside_its_nominal_place_needs_no_word():
    """W is defined by the real axis: its offset and lean come out as u_0, roll and tilts, and the scan is right."""
    table = Table(offset=np.array([0.0, 0.4, 0.0]), lean=(2e-3, 1e-3))
    run = turntable_run(np.random.default_rng(7), table=table, off={})
    cal = tp.calibrate_turntable(run.scanner, run.poses, run.observations)
    assert cal.verdict == "trustworthy"
    assert abs(values(cal)["u_0"].value - run.scanner.u_0) > 1.0
    error, stated = scan_of(run, cal)
    assert error < 4 * stated


@pytest.mark.slow
def test_the_other_sense_of_the_table_is_named_and_a_mirror_image_is_a_symmetry(cal):
    wrong = turntable_run(np.random.default_rng(5), sense=-1.0)
    found = tp.diagnose_turntable(wrong.scanner, wrong.poses, wrong.observations)
    assert {h.name for h in found.leading} == {"table sign", "columns flipped", "image turned by 180 degrees"}
    assert [h.name for h in cal.hypotheses if h.outcome == "same"] == ["rows flipped"]
    assert all(h.symmetry for h in cal.hypotheses if h.outcome == "same")


def test_a_wobbling_table_is_named_and_no_scan_is_promised_what_it_does_not_keep():
    table = Table(shift=[(1, 2, 4e-3, 0.7)])
    run = turntable_run(np.random.default_rng(9), table=table, off={})
    cal = tp.calibrate_turntable(run.scanner, run.poses, run.observations)
    assert cal.verdict != "trustworthy"
    assert any("wobble" in e.words or "tilt of the table axis" in e.words for e in cal.explanations)


def test_a_known_distance_is_the_scale_where_d_SR_is_not(run):
    length = float(np.linalg.norm(run.balls[0] - run.balls[3]))
    loose = replace(run.scanner, sigma={"d_SR": 5.0})
    cal = tp.calibrate_turntable(loose, run.poses, run.observations, distances={(0, 3): (length, 0.0005)})
    assert values(cal)["d_SR"].u < 0.2
    assert abs(values(cal)["d_SR"].value - run.values["d_SR"]) < 4 * values(cal)["d_SR"].u


def test_what_this_set_says_nothing_of_is_refused_in_words(run, cal):
    scan = tp.PoseSequence.from_table(np.zeros((8, 3)), np.linspace(0, 5, 24).reshape(8, 3), alpha=np.arange(8.0))
    with pytest.raises(InputError, match="says nothing of the manipulator"):
        tp.projection_matrices(cal, scan)
    with pytest.raises(NotObservableError, match=r"only the table turns.*--arrangement turntable"):
        tp.calibrate(run.scanner, run.poses, run.observations)
    moved = replace(run.poses, T_MH=replace(run.poses.T_MH, t=run.poses.T_MH.t + np.arange(160.0)[:, None]))
    with pytest.raises(InputError, match="the manipulator moves"):
        tp.calibrate_turntable(run.scanner, moved, run.observations)
    still = replace(run.poses, alpha=np.zeros(160))
    with pytest.raises(InputError, match="is at 1 angles only"):
        tp.calibrate_turntable(run.scanner, still, run.observations)
    short = turntable_run(np.random.default_rng(3), balls=1, span=0.05)
    with pytest.raises(NotObservableError, match=r"these circles determine .* only to"):
        tp.calibrate_turntable(short.scanner, short.poses, short.observations)


def test_it_survives_its_file(cal, tmp_path):
    tp.write_calibration(tmp_path / "c.json", cal)
    again = tp.read_calibration(tmp_path / "c.json")
    assert again.arrangement == "turntable"
    assert again.budget == cal.budget
    assert not again.inverse
