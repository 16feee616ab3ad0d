"""Manipulators whose kinematics nobody knows: a scatter for every pose, and a smooth map of pose errors.

Every pose k may differ from its commanded pose by its own small motion with a normal prior.  These slacks are never
among the unknowns: summed out they widen the covariance of the centre, C_k = C_obs,k + f J_pose V J_pose^T, and their
estimates follow from the residuals, s_k = f V J_pose^T C_k^-1 r_k.  On top, a map of low order holds what is smooth.
"""

from __future__ import annotations

import numpy as np

from tomopose.calibration.identified.map_estimate import KinematicProblem, MapEstimate, State, linearise
from tomopose.geometry.rotations import log_rotation
from tomopose.manipulator.pose_map import PoseMap
from tomopose.units import Array

LEVER_RANGE_MM = (75.0, 300.0)
"""How far from the plate's origin the joints lie that cause its errors, by a logarithmic prior from a plate's edge to
its far joints: what turns a size in mm into one in rad where the data do not determine it.  What is stated away from
the ball follows from it."""
SMALLEST_ERROR_MM = 1e-4
UNDETERMINED_SHARE = 0.25
"""Share of the prior variance of the plate's turns that may be left before they count as not determined."""


def lever_mm() -> float:
    """The lever L whose 1/L^2 is the mean of 1/L^2 over LEVER_RANGE_MM, uniform in log L."""
    low, high = LEVER_RANGE_MM
    return float(np.sqrt(2 * np.log(high / low) / (1 / low**2 - 1 / high**2)))


def map_candidates(problem: KinematicProblem, start: State) -> list[tuple[str, PoseMap]]:
    """Maps of order 1 and 2, scaled to the poses' range, their size guessed from what the rigid model leaves."""
    scanner = problem.data.scanner
    pitch = np.sqrt(scanner.p_u * scanner.p_v) / scanner.magnification
    left = max(float(np.sqrt(np.median(np.sum(linearise(problem, start).r ** 2, axis=1)))) * pitch, SMALLEST_ERROR_MM)
    t, w = problem.poses.T_MH.t, log_rotation(problem.poses.T_MH.R)
    t_scale, w_scale = float(np.abs(t).max()) or 1.0, float(np.abs(w).max()) or 1e-2
    terms = {1: 6, 2: 27}
    return [
        (
            f"map-{order}",
            PoseMap(
                order=order,
                t_scale=t_scale,
                w_scale=w_scale,
                t_sigma=2 * left,
                w_sigma=2 * left / lever_mm(),
                repeatability=problem.repeatability,
            ),
        )
        for order in (1, 2)
        if 2 * len(problem.poses) > 6 * terms[order]
    ]


def slacks(estimate: MapEstimate) -> Array:
    """(n, 6): the most probable own motion (w, t) of each pose, rad and mm, in H."""
    problem, at = estimate.problem, estimate.at
    V = problem.scatter * problem.repeatability.variance
    result: Array = V * np.einsum("nia,ni->na", at.J_pose, np.linalg.solve(at.C, at.r[:, :, None])[..., 0])
    return result


def determined_turns(estimate: MapEstimate) -> str:
    """The plain statement where the balls cannot determine the errors of the plate's turns; "" where they can.

    Compared is the variance of the map's turns at the calibration's poses with their prior variance.
    """
    problem = estimate.problem
    balls = len(problem.data.ball_ids)
    how_many = "one ball" if balls == 1 else f"{balls} balls"
    if problem.model is None:
        return (
            f"no smooth map of pose errors predicts better than none; what the plate's turns are off by is not known "
            f"from {how_many}, and the trajectory away from the ball is as uncertain as the scatter says"
        )
    m = len(problem.model.names)
    J = problem.model.real_poses(problem.poses, estimate.state.p).J[:, :3]
    after = float(np.einsum("nia,ab,nib->", J, estimate.covariance[-m:, -m:], J))
    before = float(np.einsum("nia,a,nia->", J, problem.model.sigma**2, J))
    if after < UNDETERMINED_SHARE * before:
        return ""
    u = np.sqrt(after / len(problem.poses))
    return (
        f"{how_many} cannot determine the errors of the plate's turns: {100 * after / before:.0f} % of their prior "
        f"variance is left, {1e6 * u:.0f} urad, which is {1000 * 30 * u:.1f} um at 30 mm from the ball; give the "
        "manipulator's geometry (hexapod.json, robot.json) or image more balls far apart"
    )
