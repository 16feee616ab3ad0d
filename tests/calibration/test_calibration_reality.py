"""A scanner as it is, not as it was declared: small cases with their right values, and what must never be silent."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calibration_cases import BALL, MOUNT, SCANNER, mixed_poses, observe, paper_poses

import tomopose as tp
from tomopose.calibration.model.budget import budget_words
from tomopose.calibration.result import Calibration
from tomopose.geometry.rotations import log_rotation
from tomopose.manipulator.virtual import typical_hexapod

SILENT = replace(SCANNER, sigma={})


def case(folder: Path, **options: object) -> tuple[Calibration, dict[str, list[float]]]:
    found = tp.calibrate(
        tp.read_scanner(folder / "scanner.json"),
        tp.read_poses(folder / "poses.csv"),
        tp.read_observations(folder / "observations.csv"),
        **options,
    )
    return found, json.loads((folder / "expected.json").read_text(encoding="utf-8"))


def pulls(cal: Calibration, t_HT: list[float]) -> np.ndarray:
    """t_HT minus the truth, in stated standard uncertainties."""
    by_name = {p.name: p for p in cal.parameters}
    return np.array(
        [(by_name[f"t_HT_{c}"].value - t) / by_name[f"t_HT_{c}"].u for c, t in zip("xyz", t_HT, strict=True)]
    )


@pytest.mark.parametrize("name", ["calibrate-roll", "calibrate-u0", "calibrate-tilt"])
def test_what_nobody_stated_lies_within_the_stated_uncertainty(shared_data, name):
    cal, right = case(shared_data / "cases" / name)
    assert np.abs(pulls(cal, right["t_HT_mm"])).max() < 3.0
    assert {a.name: a.source for a in cal.assumed}["eta"] == "default"


def test_a_tilted_panel_is_named_and_no_drift_or_bump_is(shared_data):
    cal, _ = case(shared_data / "cases" / "calibrate-tilt")
    assert "theta" in cal.explanations[0].words
    assert not any(word in text for text in cal.reasons for word in ("drift", "mount", "slipped", "jumped"))


def test_a_bump_before_the_last_poses_is_named_at_its_pose(shared_data):
    cal, _ = case(shared_data / "cases" / "calibrate-bump")
    assert cal.verdict != "trustworthy"
    assert any("mount changed" in r and "pose 56" in r for r in cal.reasons)
    assert any("before 56" in f.remedy for f in cal.checks)


def test_a_closing_pose_that_is_off_is_never_silent(shared_data):
    cal, right = case(shared_data / "cases" / "calibrate-repeat")
    assert np.abs(pulls(cal, right["t_HT_mm"])).max() < 3.0
    assert any("59" in f.words for f in cal.checks if f.rule == "set aside")
    assert any("taken again as 59" in f.words for f in cal.checks)


def test_certificate_sigmas_with_the_table_still_give_a_result(shared_data):
    cal, _ = case(shared_data / "cases" / "calibrate-crash")
    # 0.002 px if everything assumed were exact, 1.1 px as it is: a scan of which nobody can trust a voxel
    assert cal.verdict == "doubtful"
    assert cal.budget.measured < 0.01
    assert cal.budget.total > 1.0
    assert any("1.1 px" in r and "u_0 (1 px assumed)" in r and "Two table angles" in r for r in cal.reasons)
    assert {a.name: a.source for a in cal.assumed}["d_SR"] == "scanner.json"


def test_the_first_screen_says_what_the_uncertainty_is_made_of_and_what_would_help():
    poses = paper_poses()
    cal = tp.calibrate(SILENT, poses, observe(poses))
    words = budget_words(cal.budget, cal.assumed)
    assert "no sigma given" in words
    assert "mrad assumed" in words
    assert "Two table angles would make it" in words
    assert cal.budget.two_angles < 0.1 * cal.budget.total


def test_sigma_zero_is_exact_and_silence_is_not():
    poses = paper_poses()
    exact, silent = (tp.calibrate(s, poses, observe(poses)) for s in (SCANNER, SILENT))
    scatter = {"scatter_and_backlash_t", "scatter_and_backlash_w"}
    assert {a.source for a in exact.assumed if a.name not in scatter} == {"exact"}
    assert {a.name: (a.sigma, a.source) for a in exact.assumed if a.name in scatter} == {
        "scatter_and_backlash_t": (5e-4, "default"),
        "scatter_and_backlash_w": (12e-6, "default"),
    }
    u = {name: {p.name: p.u for p in cal.parameters}["t_HT_x"] for name, cal in (("exact", exact), ("silent", silent))}
    assert u["silent"] > 20 * u["exact"]


def test_everything_assumed_is_in_the_pixels_of_a_scan():
    poses, scan = paper_poses(), tp.circular_scan(8)
    sigma = {}
    for name, s in (("exact", SCANNER), ("silent", SILENT)):
        sigma[name] = tp.projection_matrices(tp.calibrate(s, poses, observe(poses)), scan).points_sigma_shared
    assert np.mean(sigma["silent"]) > 10 * np.mean(sigma["exact"])


def test_two_table_angles_find_the_roll_that_one_cannot_show():
    rolled = replace(SCANNER, eta=2e-3)
    poses = mixed_poses(n=80)
    # a tilt of the table axis about the beam is the same as a roll: the axis is taken as exact here
    axis = {f"axis_{name}": 0.0 for name in ("y", "tilt_x", "tilt_y")}
    cal = tp.calibrate(replace(SILENT, sigma=axis), poses, observe(poses, scanner=rolled))
    eta = {p.name: p for p in cal.parameters}["eta"]
    assert abs(eta.value - 2e-3) < 3 * eta.u < 0.2e-3
    assert "eta" in cal.explanations[0].words
    assert cal.verdict == "trustworthy"


def test_a_value_that_the_images_contradict_is_freed_and_said_unless_nothing_may_be():
    wrong = replace(SCANNER, u_0=SCANNER.u_0 + 4.0)
    poses = mixed_poses(n=80)
    stated = replace(SCANNER, sigma={**SCANNER.sigma, "u_0": 0.1})
    seen = observe(poses, scanner=wrong)
    freed = tp.calibrate(stated, poses, seen)
    u_0 = {p.name: p for p in freed.parameters}["u_0"]
    assert abs(u_0.value - wrong.u_0) < 4 * u_0.u
    assert [c.name for c in freed.contradicted] == ["u_0"]
    assert any(f.rule == "value freed" and "u_0" in f.words for f in freed.checks)
    assert tp.calibrate(stated, poses, seen, free="none").contradicted == ()


def test_a_scatter_that_is_not_significant_is_an_upper_limit_and_never_zero():
    poses = mixed_poses(n=60)
    cal = tp.calibrate(SCANNER, poses, observe(poses))
    noise = cal.pose_noise
    assert noise is not None
    assert not noise.found
    assert 1e-5 < noise.translation_mm < 5e-4
    assert 1e-7 < noise.rotation_rad < 12e-6


def test_the_makers_repeatability_is_the_prior_of_the_scatter():
    from tomopose.manipulator.real_poses import Repeatability

    poses = mixed_poses(n=40)
    fine, coarse = (
        tp.calibrate(SCANNER, poses, observe(poses), pose_noise=Repeatability(t_mm=t, w_rad=w)).pose_noise
        for t, w in ((2e-5, 1e-7), (5e-3, 5e-5))
    )
    assert fine is not None
    assert coarse is not None
    assert fine.translation_mm < 0.5 * coarse.translation_mm


@pytest.mark.slow
def test_runs_whose_scanner_is_drawn_from_the_defaults_are_accused_of_nothing():
    from tomopose.calibration.model.assumed import assumed_of

    poses = mixed_poses(n=60)
    inside = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        drawn = {a.name: a.value + a.sigma * rng.standard_normal() for a in assumed_of(SILENT)}
        cal = tp.calibrate(SILENT, poses, observe(poses, scanner=replace(SCANNER, **drawn), seed=seed))
        assert cal.verdict == "trustworthy", cal.reasons
        inside += list(np.abs(pulls(cal, MOUNT.t.tolist())) < 1.96)
    assert np.mean(inside) > 0.8


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda x, n: x + 0.3 * np.linspace(0, 1, n)[:, None], "drift"),
        (lambda x, n: x + 0.2 * (np.arange(n) >= 40)[:, None], "pose 40"),
    ],
)
def test_what_moves_with_time_is_named(change, word):
    poses = mixed_poses(n=80)
    seen = observe(poses)
    seen = replace(seen, x_D=change(np.asarray(seen.x_D), len(poses)))
    cal = tp.calibrate(SILENT, poses, seen)
    assert cal.verdict == "doubtful"
    assert any(word in r for r in cal.reasons)


def test_a_distorted_panel_is_named():
    poses = mixed_poses(n=120)
    seen = observe(poses)
    x = np.asarray(seen.x_D)
    middle = np.array([SCANNER.n_u - 1, SCANNER.n_v - 1]) / 2
    q = (x - middle) / np.linalg.norm(middle)
    bent = replace(seen, x_D=x + 1.5 * q * (q * q).sum(axis=1, keepdims=True))
    cal = tp.calibrate(SILENT, poses, bent)
    assert cal.verdict == "doubtful"
    assert "radial distortion" in cal.explanations[0].words


def test_an_assumed_scanner_still_refuses_the_scan_of_another_one():
    poses = mixed_poses(n=40)
    cal = tp.calibrate(SILENT, poses, observe(poses))
    tp.projection_matrices(cal, poses, scanner=SILENT)
    with pytest.raises(tp.errors.InputError, match="d_SR"):
        tp.projection_matrices(cal, poses, scanner=replace(SILENT, d_SR=290.0))


def test_what_was_assumed_survives_the_file(tmp_path):
    poses = mixed_poses(n=40)
    cal = tp.calibrate(SILENT, poses, observe(poses))
    tp.write_calibration(tmp_path / "calibration.json", cal)
    again = tp.read_calibration(tmp_path / "calibration.json")
    assert again.assumed == cal.assumed
    assert again.budget == cal.budget
    scan = tp.circular_scan(4)
    np.testing.assert_array_equal(
        tp.projection_matrices(again, scan).points_sigma, tp.projection_matrices(cal, scan).points_sigma
    )
    document = json.loads((tmp_path / "calibration.json").read_text(encoding="utf-8"))
    assert {"name", "sigma", "unit", "from"} <= set(document["assumed"][0])
    assert BALL.shape == (3,)


def robot_poses(n=60):
    """A robot that turns the object far about its own axis, the table at rest."""
    rng = np.random.default_rng(8)
    turns = np.column_stack([rng.uniform(-15, 15, (n, 2)), rng.uniform(-150, 150, n)])
    return tp.PoseSequence.from_table(rng.uniform(-15, 15, (n, 3)), turns)


def test_the_scale_of_a_robot_is_in_every_sigma_unless_it_is_stated():
    """One ball shows no scale of the translations; a scan made with them is too large by as much."""
    poses = robot_poses()
    seen = observe(poses)
    silent, exact = (tp.calibrate(SCANNER, poses, seen, fix=fix) for fix in ((), ("translation_scale",)))
    stated = tp.calibrate(SCANNER, poses, seen, priors={"translation_scale": 1e-5})
    assert dict(zip(silent.unseen.names, silent.unseen.sigma, strict=True))["scale_of_translations"] == 1e-3
    assert "scale_of_translations" not in exact.unseen.names
    assert silent.budget.shares[0][0] == "the scale of the translations"
    assert silent.budget.total > 10 * exact.budget.total
    assert exact.budget.total < stated.budget.total < 0.2 * silent.budget.total
    u = {n: {p.name: p.u for p in c.parameters} for n, c in (("silent", silent), ("exact", exact))}
    assert u["silent"]["t_x"] > 2 * u["exact"]["t_x"]


def test_a_platform_of_which_nothing_is_stated_has_the_scales_of_one_as_delivered():
    """Joints known to 0.01 mm make the default scales; who states every value of the scanner has better ones."""
    axes, ids = np.eye(3), [str(k) for k in range(12)]
    both = np.concatenate([np.repeat(axes, 2, axis=0) * np.tile([[1.0], [-1.0]], (3, 1))])
    poses = tp.PoseSequence.from_table(
        np.concatenate([10.0 * both, np.zeros((6, 3))]), np.concatenate([np.zeros((6, 3)), 5.0 * both]), pose_id=ids
    )
    machine = replace(typical_hexapod(), leg_sigma=0.0, scale_sigma=0.0, geometry_sigma=0.0)
    rng = np.random.default_rng(5)
    shifts, turns = [], []
    for _ in range(200):
        real = machine.real_poses(poses, 0.01 * rng.standard_normal(len(machine.names))).T_MH
        shifts.append([(real.t[2 * i] - real.t[2 * i + 1])[i] / 20.0 - 1.0 for i in range(3)])
        apart = real.R[6::2] @ np.swapaxes(real.R[7::2], 1, 2)
        turns.append(np.diag(log_rotation(apart)) / np.radians(10.0) - 1.0)
    poses = mixed_poses(n=40)
    seen = observe(poses)
    silent, stated = (tp.calibrate(s, poses, seen) for s in (SILENT, SILENT.exact()))
    delivered = dict(zip(silent.unseen.names, silent.unseen.sigma, strict=True))
    measured = dict(zip(stated.unseen.names, stated.unseen.sigma, strict=True))
    assert delivered["scale_of_translations"] == pytest.approx(np.std(np.mean(shifts, axis=1)), rel=0.2)
    assert delivered["rotation_scale_x"] == pytest.approx(np.sqrt(np.mean(np.square(turns))), rel=0.2)
    assert measured["scale_of_translations"] < 0.1 * delivered["scale_of_translations"]
    assert measured["rotation_scale_x"] < 0.2 * delivered["rotation_scale_x"]


def test_halves_of_the_poses_differ_by_what_is_stated_and_by_more_where_the_model_is_wrong():
    poses = mixed_poses(n=120)
    clean = [tp.calibrate(SILENT, poses, observe(poses, seed=k), hypotheses=False).halves for k in range(6)]
    assert 0.3 < np.mean([h.rms_px for h in clean]) / np.mean([h.stated_px for h in clean]) < 2.0
    assert min(h.p for h in clean) > 1e-4
    skew = np.eye(3) + 1e-3 * np.array([[0, 1, -1], [0, 0, 1], [0, 0, 0]])
    moved = replace(poses, T_MH=replace(poses.T_MH, t=poses.T_MH.t @ skew.T))
    wrong = tp.calibrate(SILENT, poses, observe(moved), hypotheses=False)
    assert wrong.halves.p < 1e-4
    assert any(f.rule == "halves of the poses" and f.verdict == "doubtful" for f in wrong.checks)


def test_rounding_has_no_say_in_how_likely_the_difference_of_the_halves_is():
    """With the table still the halves take many directions from the priors: there they differ by rounding."""
    poses = paper_poses()
    seen = observe(poses)
    backwards = poses[list(range(len(poses)))[::-1]]
    one, other = (tp.calibrate(SILENT, p, seen, hypotheses=False).halves.p for p in (poses, backwards))
    assert 1e-3 < one < 1.0
    assert other == pytest.approx(one, rel=1e-3)


def test_halves_survive_the_file(tmp_path):
    poses = mixed_poses(n=40)
    cal = tp.calibrate(SCANNER, poses, observe(poses), hypotheses=False)
    tp.write_calibration(tmp_path / "c.json", cal)
    again = tp.read_calibration(tmp_path / "c.json").halves
    assert (again.rms_px, again.stated_px, again.p) == (cal.halves.rms_px, cal.halves.stated_px, cal.halves.p)
    np.testing.assert_array_equal(again.difference, cal.halves.difference)


def test_a_drift_is_not_named_where_a_constant_explains_the_images():
    """u_0 and v_0 off: the constant of a drift would explain them both, and what varies is nothing."""
    poses = mixed_poses(n=80)
    axis = {f"axis_{name}": 0.0 for name in ("y", "tilt_x", "tilt_y")}
    off = replace(SCANNER, u_0=SCANNER.u_0 + 0.8, v_0=SCANNER.v_0 - 0.3)
    cal = tp.calibrate(replace(SILENT, sigma=axis), poses, observe(poses, scanner=off))
    assert not any("drift" in e.name for e in cal.explanations)
    assert cal.verdict == "trustworthy"


def test_every_finding_is_in_the_answer_of_a_quiet_command(tmp_path, capsys):
    """Sigmas ten times too large give no doubt, but a word, which --quiet must not swallow."""
    from tomopose.cli.main import run

    poses = mixed_poses(n=60)
    tp.write_scanner(tmp_path / "scanner.json", SCANNER.exact())
    tp.write_poses(tmp_path / "poses.csv", poses)
    seen = observe(poses)
    tp.write_observations(tmp_path / "o.csv", tp.BallObservations.from_sigma(seen.x_D, 0.146, pose_id=poses.pose_id))
    words = ["calibrate", "--scanner", "scanner.json", "--poses", "poses.csv", "--observations", "o.csv"]
    words = [str(tmp_path / w) if w.endswith((".json", ".csv")) else w for w in words]
    assert run([*words, "--out", str(tmp_path / "cal"), "--quiet", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert [f["rule"] for f in said["findings"]] == ["residuals below the stated uncertainty"]
    assert "chi2/dof is 0.00" in said["findings"][0]["words"]
