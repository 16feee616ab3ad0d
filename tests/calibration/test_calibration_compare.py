"""Comparison of two calibrations, the history and its control chart, shared pose errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibration_cases import BALL, MOUNT, SCANNER, SIGMA, mixed_poses, observe, paper_poses

from tomopose.calibration.model.covariance import inverse_information
from tomopose.calibration.model.parameters import free_parameters
from tomopose.calibration.model.problem import pair
from tomopose.calibration.records.charts import control_chart
from tomopose.calibration.records.compare import compare
from tomopose.calibration.records.history import append_history, read_history
from tomopose.calibration.rigid.estimate import best_fit
from tomopose.calibration.rigid.pose_error_field import (
    PoseField,
    estimate_pose_field,
    field_covariance,
    solve_with_field,
)
from tomopose.calibration.solve import calibrate
from tomopose.errors import InputError, SchemaVersionError
from tomopose.observations import BallObservations

POSES = paper_poses(2)


def run(seed, **columns):
    return calibrate(SCANNER, POSES, observe(POSES, seed=seed, **columns), hypotheses=False)


@pytest.mark.slow
def test_repetitions_do_not_differ_and_p_is_uniform():
    p = [compare(run(2 * k), run(2 * k + 1)).p_mount for k in range(40)]
    assert np.mean(np.array(p) < 0.05) < 0.2
    assert 0.3 < np.mean(p) < 0.7


def test_a_moved_mount_is_significant_and_named():
    moved = replace(MOUNT, t=MOUNT.t + [0.0, 0.01, 0.0])
    found = compare(run(1), run(2, T_HT=moved))
    assert found.mount_changed
    assert found.difference[found.names.index("t_HT_y")] == pytest.approx(0.01, abs=0.004)
    assert "changed significantly" in found.words[0]


def test_another_ball_is_no_changed_mount():
    found = compare(run(1), run(2, t=BALL + [0.05, 0.0, 0.02]))
    assert not found.mount_changed
    assert found.p_all < 1e-6
    assert "ball" in found.words[1]


def test_another_pivot_cannot_be_compared():
    a, b = (replace(run(s), pivot=np.array([0.0, 0.0, z])) for s, z in ((1, 0.0), (2, 5.0)))
    with pytest.raises(InputError, match="pivots"):
        compare(a, b)


def test_history_grows_and_its_chart_finds_the_odd_run(tmp_path):
    path = tmp_path / "history.jsonl"
    for seed in range(8):
        T_HT = MOUNT if seed != 6 else replace(MOUNT, t=MOUNT.t + [0.0, 0.05, 0.0])
        append_history(path, run(seed, T_HT=T_HT), label=f"run {seed}")
    entries = read_history(path)
    assert [e["label"] for e in entries] == [f"run {k}" for k in range(8)]
    quiet = control_chart([e for e in entries if e["label"] != "run 6"], "t_HT_y")
    assert not quiet.out.any()
    assert quiet.centre == pytest.approx(MOUNT.t[1], abs=0.002)
    full = control_chart(entries, "t_HT_y")
    assert full.out.tolist() == [k == 6 for k in range(8)]
    assert full.scatter == pytest.approx(quiet.scatter)
    assert control_chart(entries, "d_rms_px").unit == "px"
    with pytest.raises(InputError, match="three"):
        control_chart(entries[:2], "t_HT_y")
    path.write_text('{"schema": "tomopose/history/9"}\n', encoding="utf-8")
    with pytest.raises(SchemaVersionError, match="line 1"):
        read_history(path)


def entry(value, u):
    return {"parameters": {"t_HT_x": {"value": value, "u": u, "unit": "mm"}}, "time_utc": "", "d_rms_px": value}


@pytest.mark.parametrize(("n", "bump"), [(6, 14.0), (20, 6.5)])
@pytest.mark.parametrize("u", [1.0, 0.3])
def test_a_single_bumped_run_is_flagged_among_few_and_many(n, bump, u):
    """Runs scatter by 1, whether they state it (u 1) or not (u 0.3); one is off, whatever its place."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        value = rng.normal(0, 1, n)
        place = int(rng.integers(n))
        value[place] = bump
        chart = control_chart([entry(x, u) for x in value], "t_HT_x")
        assert chart.out[place]
        assert chart.out.sum() <= 2
        assert np.ptp(chart.high) < 2.0 * bump
        assert control_chart([entry(x, u) for x in value], "d_rms_px").out[place]


@pytest.mark.slow
@pytest.mark.parametrize(("n", "alarms"), [(6, 0.02), (20, 0.008)])
def test_quiet_runs_stay_inside(n, alarms):
    rng = np.random.default_rng(0)
    out = [
        control_chart([entry(x, u) for x in rng.normal(0, 1, n)], "t_HT_x").out.mean()
        for u in (1.0, 0.3)
        for _ in range(200)
    ]
    assert np.mean(out) < alarms


FIELD = PoseField(translation=0.002, rotation=0.0, field_translation=0.01, field_rotation=0.0, length=8.0)


@pytest.mark.slow
def test_shared_pose_errors_are_estimated_and_covered():
    """Drawn from their own model: the field's size is found, and the widened covariance holds the truth."""
    poses = mixed_poses(n=36)
    free = free_parameters((SCANNER,))
    exact = pair(SCANNER, poses, observe(poses, seed=None))
    root = np.linalg.cholesky(field_covariance(exact, free, best_fit(exact, free), FIELD))
    rng = np.random.default_rng(4)
    problems, fits = [], []
    for _ in range(12):
        x = exact.x_D + (root @ rng.standard_normal(72)).reshape(-1, 2)
        problems.append(pair(SCANNER, poses, BallObservations.from_sigma(x, SIGMA, pose_id=poses.pose_id)))
        fits.append(best_fit(problems[-1], free))
    field = estimate_pose_field(problems, free, fits, length=8.0)
    assert field.field_translation == pytest.approx(0.01, rel=0.35)
    inside, plain = [], []
    for problem, fit in zip(problems, fits, strict=True):
        solved, C = solve_with_field(problem, free, fit, field)
        for f, cov, result in ((solved, C, inside), (fit, inverse_information(fit.N) * fit.chi2 / 63, plain)):
            e = np.concatenate([f.t_HT - MOUNT.t, f.t[0] - BALL])
            result.append(e @ np.linalg.solve(cov[3:9, 3:9], e) / 6)
    assert np.median(inside) < 2.0
    assert np.median(plain) > np.median(inside)
