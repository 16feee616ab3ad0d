"""Every kind of error on its own: a virtual machine with exactly that error, believed to have any; and the optimum."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from manipulator_cases import (
    ROBOT_BALLS,
    ROBOT_OBJECT,
    X_WORK,
    Experiment,
    experiment,
    hexapod_experiment,
    mixed_poses,
    robot_plan,
    robot_scan,
    scan_error,
    tilted_scan,
)
from scipy.optimize import least_squares

from tomopose import Calibration, Frame, RigidTransform
from tomopose.calibration.identified.calibrate import calibrate_kinematic
from tomopose.calibration.identified.map_estimate import KinematicProblem, State, linearise, solve_map
from tomopose.calibration.model.ball_projection import whiteners
from tomopose.calibration.model.parameters import free_parameters
from tomopose.calibration.model.problem import pair
from tomopose.calibration.solve import calibrate
from tomopose.errors import OutOfReachError, TrajectoryError
from tomopose.geometry.rotations import R_x
from tomopose.manipulator.serial import SerialRobot, poses_from_joints
from tomopose.manipulator.virtual import typical_hexapod, typical_robot

MOUNT = RigidTransform.from_angles([0.01, -0.02, 3.1], [1.0, -2.0, 0.5], source=Frame.H, target=Frame.T)
ANY = replace(typical_hexapod(), leg_scale_sigma=5e-4, axes_sigma=1e-3, pivot_sigma=0.2)
"""A hexapod that may have every error of the model."""


def both(e: Experiment) -> tuple[Calibration, Calibration]:
    rigid = calibrate(e.scanner, e.poses, e.observations, model="rigid", hypotheses=False)
    return rigid, calibrate_kinematic(e.scanner, e.poses, e.observations, rigid=rigid, manipulator=e.machine)


def hexapod_with(group: str, size: float = 1.0) -> Experiment:
    """A machine in which the errors of one group are drawn from their prior, and all others are zero."""
    rng = np.random.default_rng(np.random.SeedSequence([21, len(group)]))
    p = size * rng.standard_normal(len(ANY.names)) * ANY.sigma
    p[[not name.startswith(group) for name in ANY.names]] = 0.0
    assert p.any()
    return experiment(ANY, p, mixed_poses(rng), tilted_scan(MOUNT), T_HT=MOUNT, balls=[[12.0, -14.0, 10.0]], rng=rng)


@pytest.mark.slow
@pytest.mark.parametrize("group", ["base_joint", "platform_joint", "leg_offset", "leg_scale", "axes"])
def test_one_group_of_errors_alone(group: str) -> None:
    e = hexapod_with(group)
    rigid, cal = both(e)
    before, after = scan_error(rigid, e), scan_error(cal, e)
    assert before.shared > 0.05, "it matters"
    assert cal.model == "kinematic"
    assert after.shared < 0.05
    assert after.shared < 3 * after.u_shared
    assert after.shared < 0.4 * before.shared
    assert 0.9 < after.inside < 0.99


@pytest.mark.slow
def test_a_wrong_pivot_alone_does_no_harm() -> None:
    """The controller turns about another point than it says: mount and ball take it up, and no scan is wrong."""
    e = hexapod_with("pivot")
    rigid, cal = both(e)
    assert cal.model == "rigid"
    assert scan_error(rigid, e).shared < 0.006


@pytest.mark.slow
@pytest.mark.parametrize("what", ["tool", "gear", "alpha"])
def test_robot_with_one_error(what: str) -> None:
    """A wrong tool is taken up by ball and object; eccentric gears and twisted links are found."""
    rng = np.random.default_rng(5)
    robot = typical_robot(eccentricity_sigma=2e-4)
    p = rng.standard_normal(len(robot.names)) * robot.sigma
    belongs = {"tool": "none", "gear": "_e_", "alpha": "_alpha"}[what]
    p[[belongs not in name for name in robot.names]] = 0.0
    real: SerialRobot = robot
    if what == "tool":
        tool = np.eye(4)
        tool[:3, :3], tool[:3, 3] = R_x(np.radians(0.5)), [0.4, -0.3, 0.6]
        real = replace(robot, tool=tool)
    T_HT = RigidTransform.from_angles([0.01, -0.02, 2.8], np.zeros(3), source=Frame.H, target=Frame.T)
    T_HT = replace(T_HT, t=-(T_HT.R @ X_WORK))
    plan = robot_plan(robot, rng, n=120, balls=1, spin=2.9, tilt=0.35, shift=10.0, table=True)
    # the joints are what both have in common
    as_real = [poses_from_joints(real, np.asarray(s.q), alpha=s.alpha) for s in (plan, robot_scan(robot))]
    e = experiment(real, p, as_real[0], as_real[1], T_HT=T_HT, balls=ROBOT_BALLS[:1], rng=rng, centre=ROBOT_OBJECT)
    e = replace(e, machine=robot, poses=plan, scan=robot_scan(robot))
    rigid, cal = both(e)
    assert cal.model == ("rigid" if what == "tool" else "kinematic")
    assert scan_error(cal, e).shared < (0.006 if what == "tool" else 0.03)
    if what != "tool":
        assert scan_error(cal, e).shared < scan_error(rigid, e).shared / 5


# -- the optimum ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "seed"), [("paper", 1), ("mixed", 2)])
def test_no_other_solver_finds_less(kind: str, seed: int) -> None:
    """A long run of SciPy's trust-region solver on the same cost, from some sigmas away, ends in the same place."""
    e = hexapod_experiment(typical_hexapod(), kind, seed)
    data = pair(e.scanner, e.poses, e.observations)
    problem = KinematicProblem(
        data=data,
        poses=e.poses,
        free=free_parameters(data.scanners),
        model=e.machine,
        repeatability=e.machine.repeatability,
    )
    rigid = calibrate(e.scanner, e.poses, e.observations, model="rigid", hypotheses=False)
    start = State(
        T_HT=rigid.T_HT, balls=np.array([rigid.balls[0]]), delta=np.zeros(0), p=np.zeros(len(e.machine.names))
    )
    found = solve_map(problem, start)
    W = whiteners(found.at.C)
    k, u = 9, np.sqrt(np.diag(found.covariance))
    away = found.state.moved(2 * u * np.random.default_rng(seed).standard_normal(len(u)))

    def rows(step: Any) -> Any:
        state = away.moved(step)
        return np.concatenate([(W @ linearise(problem, state).r[:, :, None]).ravel(), state.p / e.machine.sigma])

    def slope(step: Any) -> Any:
        J = -(W @ linearise(problem, away.moved(step)).J).reshape(2 * len(data), -1)
        prior = np.concatenate([np.zeros((len(e.machine.names), k)), np.diag(1 / e.machine.sigma)], axis=1)
        return np.concatenate([J, prior])

    other = least_squares(rows, np.zeros(len(u)), slope, x_scale=u, xtol=1e-14, ftol=1e-14, gtol=1e-14, max_nfev=400)
    assert found.chi2 < 2 * other.cost + 1e-2
    assert (np.abs(away.moved(other.x).p - found.state.p) < 0.2 * u[k:]).all()


# -- machines that cannot be -------------------------------------------------------------------------------------------


def test_poses_out_of_reach_and_singular_platforms_stop_a_calibration() -> None:
    e = hexapod_experiment(typical_hexapod(), "mixed", 0)
    short = replace(e.machine, leg_limits=(249.0, 251.0))
    flat = replace(e.machine, platform_joints=e.machine.base_joints * [0.5, 0.5, 1.0] + [0.0, 0.0, 240.0])
    rigid = calibrate(e.scanner, e.poses, e.observations, model="rigid", hypotheses=False)
    for machine, error, words in ((short, OutOfReachError, "outside 249 to 251"), (flat, TrajectoryError, "singular")):
        with pytest.raises(error, match=words):
            calibrate_kinematic(e.scanner, e.poses, e.observations, rigid=rigid, manipulator=machine)
