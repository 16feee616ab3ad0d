"""Readings of the orientation columns that the calibration's poses cannot distinguish, and what they do to a scan.

Poses that turn about one axis at a time fit every order of the angles.  A scan that turns about two axes does not: the
same commands then mean other poses.  Each such reading is fitted, both are applied to a tilted scan, and what is left
between the two beside a rigid motion of the object is what the scan would be off if the other reading were right.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from tomopose.calibration.checks.conventions.alternative import Alternative
from tomopose.calibration.checks.conventions.fits import optimum_under
from tomopose.calibration.checks.conventions.hypothesis import Diagnosis
from tomopose.calibration.checks.conventions.orientation_readings import orientation_alternatives
from tomopose.calibration.checks.evidence.evidence import Undistinguished
from tomopose.calibration.model.parameters import FreeParameters, adjusted_scanners
from tomopose.calibration.model.problem import Problem
from tomopose.calibration.model.silhouettes import chain_matrices
from tomopose.calibration.rigid.fit import Fit
from tomopose.geometry.box import BOX_CORNERS
from tomopose.geometry.object_pose import object_pose, pixels
from tomopose.geometry.rotations import exp_rotation
from tomopose.units import Array

VIEWS = 12
TILT = np.radians(5.0)
OBJECT_MM = 15.0
"""Half the side of the box whose corners the scan images: the paper's part is 30 mm wide."""


def undistinguished_readings(
    problem: Problem, free: FreeParameters, fit: Fit, diagnosis: Diagnosis, alternatives: Iterable[Alternative]
) -> tuple[Undistinguished, ...]:
    """Those that matter, worst first; none where the columns are not known or the user has confirmed the convention."""
    if problem.orientations is None or problem.convention_confirmed:
        return ()
    by_name = {a.name: a for a in alternatives}
    readings = {a.name for a in orientation_alternatives()} & by_name.keys()
    found = []
    for h in diagnosis.same:
        if h.name not in readings:
            continue
        px = _scan_difference(problem, free, fit, by_name[h.name])
        found.append(Undistinguished(name=h.name, words=h.words, remedy=h.remedy, px=px))
    return tuple(sorted(found, key=lambda u: -u.px))


def tilted_views(problem: Problem) -> Problem:
    """The poses of a scan: one turn of the table, the plate tilted about two axes.  Its centres mean nothing."""
    alpha = np.linspace(0.0, 2 * np.pi, VIEWS, endpoint=False)
    w = np.column_stack([TILT * np.sin(2 * alpha), TILT * np.cos(2 * alpha + 0.5), np.zeros(VIEWS)])
    return replace(
        problem.select(np.zeros(VIEWS, dtype=int)),
        R_MH=exp_rotation(w),
        t_MH=np.tile(problem.t_MH.mean(axis=0), (VIEWS, 1)),
        alpha=alpha,
        orientations=None,
    )


def _scan_difference(problem: Problem, free: FreeParameters, fit: Fit, alternative: Alternative) -> float:
    scan = tilted_views(problem)
    changed, executed = alternative.change(problem), alternative.change(scan)
    if changed is None or executed is None:
        return 0.0
    other = optimum_under(changed, free)
    P = chain_matrices(scan, adjusted_scanners(problem.scanners, free, fit.delta), fit.T_HT)
    Q = chain_matrices(executed, adjusted_scanners(problem.scanners, free, other.delta), other.T_HT)
    corners = OBJECT_MM * BOX_CORNERS
    return _apart(P, Q, corners + fit.t[0], corners + other.t[0])


def _apart(P: Array, Q: Array, x: Array, y: Array) -> float:
    """px, rms of a coordinate: points x (m, 3) under P (n, 3, 4) and y under Q, a rigid motion of y taken out."""
    target = pixels(P, x)
    R, t = object_pose(Q, target, y)
    return float(np.sqrt(np.mean((target - pixels(Q, y @ R.T + t)) ** 2)))
