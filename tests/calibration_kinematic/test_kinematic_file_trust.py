"""Averages over how far a hexapod's file is right."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from manipulator_cases import Experiment, hexapod_experiment, scan_error

from tomopose.calibration.identified.calibrate import calibrate_kinematic
from tomopose.calibration.identified.fit import ModelFit, fit_model
from tomopose.calibration.identified.geometry_prior import SHARES, averaged, believed
from tomopose.calibration.identified.map_estimate import KinematicProblem, State, solve_map
from tomopose.calibration.model.parameters import free_parameters
from tomopose.calibration.model.problem import pair
from tomopose.calibration.solve import calibrate
from tomopose.manipulator.inverse import InverseManipulator
from tomopose.manipulator.run_effects import with_run_effects
from tomopose.manipulator.virtual import typical_hexapod, typical_robot

HEXAPOD = typical_hexapod()


def fitted(e: Experiment, machine: Any) -> ModelFit:
    data = pair(e.scanner, e.poses, e.observations)
    rigid = calibrate(e.scanner, e.poses, e.observations, model="rigid", hypotheses=False)
    problem = KinematicProblem(data=data, poses=e.poses, free=free_parameters(data.scanners), model=machine)
    balls = np.array([rigid.balls[i] for i in data.ball_ids])
    return fit_model(problem, State(T_HT=rigid.T_HT, balls=balls, delta=np.zeros(0), p=np.zeros(len(machine.names))))


def test_mean_and_covariance_are_those_of_the_mixture() -> None:
    """Against three solutions weighted by hand."""
    fit = fitted(hexapod_experiment(HEXAPOD, "mixed", 1, geometry=1.05), HEXAPOD)
    found = averaged(fit).estimate
    parts = [
        solve_map(replace(fit.estimate.problem, model=believed(fit.estimate.problem.model, s)), fit.estimate.state)
        for s in SHARES
    ]
    w = np.exp([e.log_evidence - max(x.log_evidence for x in parts) for e in parts])
    w = w / w.sum()
    assert w.min() > 1e-3, "all three have a part"
    p = np.array([e.state.p for e in parts])
    np.testing.assert_allclose(found.state.p, w @ p, atol=1e-6)
    m = len(HEXAPOD.names)
    second = sum(x * (e.covariance[-m:, -m:] + np.outer(q, q)) for x, e, q in zip(w, parts, p, strict=True))
    np.testing.assert_allclose(found.covariance[-m:, -m:], second - np.outer(w @ p, w @ p), atol=1e-8)
    assert found.chi2 == fit.estimate.chi2


def test_nothing_is_averaged_where_no_file_is_doubted() -> None:
    exact = replace(HEXAPOD, scale_sigma=0.0, geometry_sigma=0.0)
    fit = fitted(hexapod_experiment(HEXAPOD, "paper", 0), exact)
    assert averaged(fit) is fit
    assert believed(typical_robot(), 0.1) is None
    assert believed(None, 0.1) is None


def test_the_file_is_found_inside_other_models() -> None:
    poses = hexapod_experiment(HEXAPOD, "paper", 0).poses
    for model in (InverseManipulator(machine=HEXAPOD), with_run_effects(HEXAPOD, poses)):
        other = believed(model, 0.1)
        assert other is not None
        changed = other.sigma != model.sigma
        assert [n for n, c in zip(model.names, changed, strict=True) if c] == [
            n for n in HEXAPOD.names if n.startswith("geometry")
        ]


@pytest.mark.slow
@pytest.mark.parametrize(("geometry", "limit"), [(1.0, 0.022), (1.08, 0.03)])
def test_right_and_wrong_files_give_a_good_scan(geometry: float, limit: float) -> None:
    """Scans of 8 deg beyond the calibrated 5 deg; the stated uncertainty holds for both."""
    errors, stated = [], []
    for seed in range(6):
        e = hexapod_experiment(HEXAPOD, "mixed", seed, geometry=geometry, wide=True)
        rigid = calibrate(e.scanner, e.poses, e.observations, model="rigid", hypotheses=False)
        x = scan_error(calibrate_kinematic(e.scanner, e.poses, e.observations, rigid=rigid, manipulator=e.machine), e)
        errors.append(x.shared)
        stated.append(x.u_shared)
    rms, said = (float(np.sqrt(np.mean(np.square(v)))) for v in (errors, stated))
    assert rms < limit
    assert 0.5 < rms / said < 1.6
