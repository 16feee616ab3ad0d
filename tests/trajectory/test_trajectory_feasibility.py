"""Travel limits, field of view, keep-out boxes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tomopose import PoseSequence, RigidTransform
from tomopose.errors import InputError, OutOfReachError, OutOfViewError, ShapeError
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import eq5_matrices, project, project_ball
from tomopose.trajectory.feasibility import (
    TravelLimits,
    ball_in_view,
    ball_outline,
    beyond_travel,
    collisions,
    cylinder,
    in_view,
    require_in_view,
    require_reachable,
)
from tomopose.trajectory.pose_grid import pose_grid
from tomopose.trajectory.scan import circular_scan, tilted_scan
from tomopose.trajectory.tilt import eq11_triangle


def test_travel_limits_name_the_worst_pose_and_axis():
    poses = pose_grid(2)
    require_reachable(poses, TravelLimits.symmetric(x=10, ry=math.radians(5)))
    limits = TravelLimits.symmetric(x=10, z=9, ry=math.radians(4))
    assert beyond_travel(poses, limits).max(axis=0)[2] == pytest.approx(1.0)
    with pytest.raises(OutOfReachError, match=r"pose '0' needs z = -10 mm, the travel is -9 to 9 mm") as caught:
        require_reachable(poses, limits)
    assert len(caught.value.indices) == 56
    assert caught.value.limits is limits


def test_travel_limits_speak_of_angles_in_degrees():
    with pytest.raises(OutOfReachError, match=r"needs ry = 5 deg, the travel is -4 to 4 deg"):
        require_reachable(pose_grid(2), TravelLimits.symmetric(ry=math.radians(4)))


def test_bad_limits_are_refused():
    with pytest.raises(ShapeError, match="7 values"):
        TravelLimits(low=[0, 0, 0], high=[1, 1, 1])
    with pytest.raises(InputError, match="above its high"):
        TravelLimits.symmetric(x=-1)


def test_the_cylinder_in_view_holds_the_true_one(scanner, T_HT):
    poses = tilted_scan(11, eq11_triangle, R_HT=T_HT.R)
    P = eq5_matrices(scanner, T_HT=T_HT, T_MH=poses.T_MH, alpha=poses.alpha)
    corners = project(P, cylinder(20, -15, 25, corners=32))
    phi = np.linspace(0, 2 * np.pi, 400)
    rims = np.vstack([np.column_stack([20 * np.cos(phi), 20 * np.sin(phi), np.full(400, z)]) for z in (-15, 25)])
    true = project(P, rims)
    assert (true.min(axis=1) >= corners.min(axis=1)).all()
    assert (true.max(axis=1) <= corners.max(axis=1)).all()
    assert (true.max(axis=1) > corners.max(axis=1) - 3).all()


def test_views_that_lose_the_object_are_named(scanner, T_HT):
    poses = circular_scan(8)
    P = eq5_matrices(scanner, T_HT=T_HT, T_MH=poses.T_MH, alpha=poses.alpha)
    require_in_view(P, cylinder(20, -10, 10), n_u=scanner.n_u, n_v=scanner.n_v)
    far = np.array([[39.0, 0.0, 0.0]])
    seen = in_view(P, far, n_u=scanner.n_u, n_v=scanner.n_v)
    assert 0 < seen.sum() < 8
    with pytest.raises(OutOfViewError, match="1 of 1 points are outside") as caught:
        require_in_view(P, far, n_u=scanner.n_u, n_v=scanner.n_v)
    assert caught.value.indices == tuple(np.flatnonzero(~seen[:, 0]))


def test_the_outline_of_a_ball_is_that_of_its_surface_points(scanner, T_HT, rng):
    poses = pose_grid(2, table_angles=(0.0, 1.0))
    t, radius = np.array([3.0, -2.0, 5.0]), 4.0
    low, high = ball_outline(scanner, T_HT=T_HT, poses=poses, t=t, radius=radius)
    z = rng.uniform(-1, 1, 40000)
    phi = rng.uniform(0, 2 * np.pi, 40000)
    r = np.sqrt(1 - z**2)
    surface = t + radius * np.column_stack([r * np.cos(phi), r * np.sin(phi), z])
    for k in (0, 13, 60, 111):
        one = PoseSequence(T_MH=poses.T_MH[k : k + 1], pose_id=("k",), alpha=poses.alpha[k : k + 1])
        x_D = project_ball(
            scanner,
            T_HT=T_HT,
            t=surface,
            alpha=np.full(len(surface), one.alpha[0]),
            T_MH=RigidTransform(
                R=np.repeat(one.T_MH.R, len(surface), axis=0),
                source=Frame.M,
                target=Frame.H,
                t=np.repeat(one.T_MH.t, len(surface), axis=0),
            ),
        )
        assert (x_D.min(axis=0) >= low[k] - 1e-6).all()
        assert (x_D.max(axis=0) <= high[k] + 1e-6).all()
        np.testing.assert_allclose(x_D.min(axis=0), low[k], atol=0.05)
        np.testing.assert_allclose(x_D.max(axis=0), high[k], atol=0.05)


def test_a_ball_at_the_edge_is_in_view_until_its_margin_is_not(scanner, T_HT):
    poses = pose_grid(2)
    kwargs = {"T_HT": T_HT, "poses": poses, "t": np.array([3.0, -2.0, 5.0]), "radius": 4.0}
    assert ball_in_view(scanner, **kwargs).all()
    low, _ = ball_outline(scanner, **kwargs)
    partly = ball_in_view(scanner, **kwargs, margin=float(np.median(low.min(axis=1))) + 0.5)
    assert 0 < partly.sum() < len(poses)


def test_a_keep_out_box_is_entered_by_some_poses(scanner, T_HT):
    poses = circular_scan(12)
    arm = np.column_stack([np.linspace(0, 60, 61), np.zeros(61), np.zeros(61)])
    low, high = np.array([40.0, -10, -20]), np.array([80.0, 10, 20])
    hit = collisions(scanner, T_HT=T_HT, poses=poses, x_M=arm, low=low, high=high)
    assert 0 < hit.sum() < 4
    assert not collisions(scanner, T_HT=T_HT, poses=poses, x_M=arm[:20], low=low, high=high).any()
