"""What views of a part are worth: path lengths, coverage, completeness, choice and bound, against what is known."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

import tomopose as tp
from tomopose.errors import InputError, OutOfReachError
from tomopose.geometry.rotations import R_z
from tomopose.manipulator.hexapod import Hexapod
from tomopose.measurement.mesh.mesh import Mesh
from tomopose.measurement.plan import plan_from
from tomopose.planning.part.keep_out import Obstacle
from tomopose.planning.part.material_paths import material_paths
from tomopose.planning.part.part import Part, require_simple
from tomopose.planning.part.settings import PartSettings
from tomopose.planning.part.worth import Goal, table, worth
from tomopose.planning.part_scan.choose import choose, dual_bound, value
from tomopose.planning.part_scan.limits_file import ScanLimits, default_travel, read_limits
from tomopose.planning.part_scan.plan import plan_part_scan
from tomopose.planning.part_scan.setting import Setting
from tomopose.planning.part_scan.stations import allowed
from tomopose.planning.part_scan.visit import travel, visiting_order
from tomopose.reconstruction.choice import path_obstacle
from tomopose.trajectory.completeness import source_path
from tomopose.trajectory.feasibility import TravelLimits

HALF = np.array([9.0, 7.0, 2.5])
QUADS = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]


def box(half: np.ndarray = HALF, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Mesh:
    corners = np.array(list(itertools.product((-1, 1), (-1, 1), (-1, 1)))) * half + centre
    faces = [t for a, b, c, d in QUADS for t in ((a, c, b), (a, d, c))]
    mesh = Mesh(points=corners, faces=np.array(faces))
    a = mesh.points[mesh.faces[:, 0]] - mesh.points.mean(axis=0)
    flip = np.einsum("ij,ij->i", a, mesh.face_normals) < 0
    turned = np.where(flip[:, None], mesh.faces[:, ::-1], mesh.faces)
    return Mesh(points=corners, faces=turned)


def looking(source: np.ndarray) -> np.ndarray:
    z = -source / np.linalg.norm(source)
    x = np.cross(z, [0.3, 0.5, 0.8])
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    K = np.array([[-900.0, 0.0, 101.3], [0.0, 1100.0, 77.7], [0.0, 0.0, 1.0]])
    return K @ np.column_stack([R, -R @ source])


@pytest.fixture
def small_scanner() -> tp.Scanner:
    return tp.Scanner(d_SD=1000.0, d_SR=400.0, p_u=0.4, p_v=0.375, u_0=130.3, v_0=126.1, n_u=261, n_v=255)


FACES = {
    "top": {"kind": "plane", "point": [0, 0, 2.5], "direction": [0, 0, 1], "u": [8, 0, 0], "v": [0, 6, 0]},
    "side": {"kind": "plane", "point": [9, 0, 0], "direction": [1, 0, 0], "u": [0, 6, 0], "v": [0, 0, 1.5]},
}


def features(**changed: object) -> tp.MeasurementPlan:
    measurand = {"name": "form", "kind": "form", "of": ["top"]}
    return plan_from(
        {"schema": "tomopose/measurement-plan/1", "unit": "mm", "features": FACES, "measurands": [measurand], **changed}
    )


def setting(scanner: tp.Scanner, **changed: object) -> Setting:
    given = {
        "scanner": scanner,
        "part": Part(mesh=box()),
        "views": 12,
        "settings": PartSettings(mu=0.05, alpha_step=math.radians(9.0)),
        "features": features(),
    }
    return Setting(**{**given, **changed})


def test_lengths_through_a_box_are_those_of_the_slabs(rng):
    S = rng.normal(size=(20, 3))
    S *= 100 / np.linalg.norm(S, axis=1)[:, None]
    P, x = np.array([looking(s) for s in S]), rng.uniform(-12, 12, (300, 3))
    mesh = box()
    L, winding = material_paths(P, mesh.points, mesh.faces, x)
    d = x[None] - S[:, None]
    d /= np.linalg.norm(d, axis=2)[..., None]
    ends = np.sort([(-HALF - S[:, None]) / d, (HALF - S[:, None]) / d], axis=0)
    np.testing.assert_allclose(L, np.maximum(ends[1].min(axis=2) - ends[0].max(axis=2), 0.0), atol=1e-10)
    np.testing.assert_array_equal(winding, np.broadcast_to((np.abs(x) < HALF).all(axis=1), winding.shape))


def test_a_line_through_an_edge_or_a_corner_meets_the_box_once():
    mesh = box()
    s = np.array([60.0, 25.0, 40.0])
    x = np.concatenate([(mesh.points[a] + mesh.points[b])[None] / 2 for a, b, _ in mesh.faces] + [mesh.points])
    L, _ = material_paths(looking(s)[None], mesh.points, mesh.faces, x)
    inside = 1e-9 * (mesh.points.mean(axis=0) - x)
    near, _ = material_paths(looking(s)[None], mesh.points, mesh.faces, x + inside)
    # a silhouette edge has no length, any other the length beside it
    assert (np.minimum(np.abs(L - near), np.abs(L)) < 1e-6).all()


def test_the_mean_chord_of_a_convex_body_is_four_volumes_over_its_surface(rng):
    """Crofton, for lines that are isotropic and uniform: parallel beams from far away."""
    mesh, n = box(), 6000
    d = rng.normal(size=(40, 3))
    d /= np.linalg.norm(d, axis=1)[:, None]
    total = lines = 0.0
    for direction in d:
        u = np.linalg.svd(direction[None])[2][1:]
        x = rng.uniform(-13, 13, (n // 40, 2)) @ u
        L, _ = material_paths(looking(1e5 * direction)[None], mesh.points, mesh.faces, x)
        total, lines = total + L.sum(), lines + (L > 0).sum()
    volume, surface = 8 * HALF.prod(), 8 * (HALF[0] * HALF[1] + HALF[1] * HALF[2] + HALF[2] * HALF[0])
    assert total / lines == pytest.approx(4 * volume / surface, rel=0.05)


def test_an_open_mesh_an_inverted_one_and_overlapping_shells_are_refused():
    mesh = box()
    with pytest.raises(InputError, match="open: 3 edges"):
        Part(mesh=Mesh(points=mesh.points, faces=mesh.faces[1:]))
    with pytest.raises(InputError, match="inside out"):
        Part(mesh=Mesh(points=mesh.points, faces=mesh.faces[:, ::-1]))
    other = box(centre=(4.0, 3.0, 1.0))
    both = Mesh(points=np.concatenate([mesh.points, other.points]), faces=np.concatenate([mesh.faces, other.faces + 8]))
    with pytest.raises(InputError, match="shells of the mesh overlap"):
        require_simple(Part(mesh=both))
    require_simple(Part(mesh=mesh))


def test_a_circle_meets_all_planes_through_its_centre_and_none_near_the_missing_cone(small_scanner):
    """T at the centre is 1; a plane through a point at height h whose normal lies within h / d of z is not met."""
    task = setting(small_scanner)
    q = np.zeros((3600, 7))
    q[:, 6] = np.arange(3600) * 2 * np.pi / 3600
    P = task.machine.matrices(q)
    part, planes = task.part, task.goal().planes
    settings = PartSettings(mu=1e-6, tuy_width=math.radians(0.5))
    at = {"part": part, "targets": task.goal().targets, "planes": planes, "settings": settings}
    assert worth(Goal(x_tuy=np.zeros((1, 3)), **at), P).T > 0.99
    h = 60.0
    v = table(Goal(x_tuy=np.array([[0.0, 0.0, h]]), **at), P)
    met = v.A[:, -len(planes) :].max(axis=0)
    cap = planes[:, 2] > math.cos(math.asin(h / math.hypot(h, small_scanner.d_SR)) - math.radians(2.0))
    assert cap.any()
    assert met[cap].max() < 0.01
    assert met[planes[:, 2] < math.cos(math.atan(h / small_scanner.d_SR) + math.radians(2.0))].min() > 0.5


def test_gains_never_grow_and_more_views_never_lower_the_worth(small_scanner, rng):
    task = setting(small_scanner)
    q = task.machine.clipped(rng.uniform(-0.1, 0.1, (40, 7)) + np.eye(1, 7, 6) * rng.uniform(0, 6, (40, 1)))
    v, w = table(task.goal(), task.machine.matrices(q)), task.goal().w
    for _ in range(50):
        T = rng.choice(40, 12, replace=False)
        S, j = T[:5], int(rng.integers(40))
        gain = [value(v.A, v.M, w, np.append(rows, j)) - value(v.A, v.M, w, rows) for rows in (S, T)]
        assert gain[0] >= gain[1] - 1e-9
        assert w @ v.A[T].max(axis=0) >= w @ v.A[S].max(axis=0)


def test_the_bound_holds_and_the_choice_is_near_the_best_of_all(rng):
    for _ in range(10):
        A = (rng.random((12, 30)) ** 3).astype(np.float32)
        m, w = 0.01 * rng.random(12), rng.random(30)
        best = max(value(A, m, w, np.array(rows)) for rows in itertools.combinations(range(12), 4))
        rows = choose(A, m, w, 4)
        reached = value(A, m, w, rows)
        assert len(set(rows.tolist())) == 4
        assert reached >= 0.97 * best
        bound = dual_bound(A, m, w, 4, prices=A[rows].max(axis=0), reached=reached)
        assert best <= bound + 1e-6
        assert bound <= 1.05 * best


@pytest.mark.slow
def test_a_plan_keeps_to_narrow_one_sided_and_empty_intervals(small_scanner):
    low, high = np.array([-3.0, 1.0, 0.0, -0.05, 0.0, 0.0, 0.4]), np.array([2.0, 1.0, 4.0, 0.02, 0.06, 0.0, 2.5])
    limits = ScanLimits(travel=TravelLimits(low=low, high=high))
    plan = plan_part_scan(setting(small_scanner, limits=limits))
    table_rows = np.column_stack([plan.poses.T_MH.t, plan.poses.T_MH.angles, plan.poses.alpha])
    assert (table_rows >= low - 1e-9).all()
    assert (table_rows <= high + 1e-9).all()
    assert len(plan) == 12


@pytest.mark.slow
def test_a_plan_is_worth_more_than_the_usual_paths_and_near_its_bound(small_scanner):
    plan = plan_part_scan(setting(small_scanner))
    assert max(j.worth.J for j in plan.paths.values()) < plan.chosen.worth.J
    assert 0.95 * plan.bound < plan.planned_J <= plan.bound
    assert plan.chosen.out_of_view == 0
    P = tp.geometry.projection.eq5_matrices(
        small_scanner, T_HT=plan.machine.T_HT, T_MH=plan.poses.T_MH, alpha=plan.poses.alpha
    )
    np.testing.assert_allclose(source_path(P), plan.source_path, atol=1e-9)
    again = plan_part_scan(setting(small_scanner))
    np.testing.assert_array_equal(again.poses.alpha, plan.poses.alpha)


def test_a_turned_part_is_worth_the_same_with_a_turned_table(small_scanner):
    task = setting(small_scanner, features=None)
    turned = Part(mesh=Mesh(points=task.part.mesh.points @ R_z(math.pi / 2).T, faces=task.part.mesh.faces))
    q = np.zeros((16, 7))
    q[:, 6], q[:, 4] = np.linspace(0, 6, 16), 0.05
    quarter = q + np.eye(1, 7, 6) * -math.pi / 2
    # a tilt about the plate's y of the part is one about its x after the quarter turn
    quarter[:, 3], quarter[:, 4] = -q[:, 4], 0.0
    here = worth(task.goal(), task.machine.matrices(q))
    goal = Goal(
        part=turned,
        targets=tuple(
            type(t)(**{**t.__dict__, "x": t.x @ R_z(math.pi / 2).T, "n": t.n @ R_z(math.pi / 2).T})
            for t in task.goal().targets
        ),
        x_tuy=task.goal().x_tuy @ R_z(math.pi / 2).T,
        planes=task.goal().planes @ R_z(math.pi / 2).T,
        settings=task.settings,
    )
    there = worth(goal, task.machine.matrices(quarter))
    assert pytest.approx(here.J, abs=1e-6) == there.J


def test_an_order_keeps_the_set_and_never_lengthens(small_scanner, rng):
    machine = setting(small_scanner).machine
    q = machine.clipped(rng.uniform(-0.08, 0.08, (25, 7)) + np.eye(1, 7, 6) * rng.uniform(0, 6.2, (25, 1)))
    order = visiting_order(machine, q)
    assert sorted(order.tolist()) == list(range(25))
    assert travel(machine, q[order]) <= travel(machine, q)
    ends = np.array([[0.0] * 6 + [0.1], [0.0] * 6 + [2 * math.pi - 0.1]])
    assert travel(machine, ends) == pytest.approx(math.degrees(0.2))


@pytest.mark.slow
def test_what_hits_an_obstacle_is_left_out(small_scanner):
    task = setting(small_scanner)
    wall = Obstacle(name="wall", mesh=box(np.array([1.0, 40.0, 40.0]), centre=(11.0, 0.0, 0.0)))
    q = np.zeros((4, 7))
    q[:, 6] = np.radians([0.0, 90.0, 45.0, 2.0])
    free = allowed(task.machine, task.part, q, margin=1.0)
    assert free.all()
    blocked = setting(small_scanner, limits=ScanLimits(obstacles=(wall,))).machine
    # at 0 deg the box reaches x = 9, at 45 deg its corner 11.3: into the wall that begins at 10
    np.testing.assert_array_equal(allowed(blocked, task.part, q, margin=1.0), [True, True, False, True])
    around = Obstacle(name="housing", mesh=box(np.array([30.0, 30.0, 30.0])))
    coarse = PartSettings(mu=0.05, alpha_step=math.radians(40.0), tilt_step=math.radians(9.0))
    inside = setting(small_scanner, limits=ScanLimits(obstacles=(around,)), settings=coarse)
    with pytest.raises(OutOfReachError, match="housing"):
        plan_part_scan(inside)


def test_what_cannot_be_planned_is_said_in_words(small_scanner):
    with pytest.raises(OutOfReachError, match="larger than the view"):
        plan_part_scan(setting(small_scanner, part=Part(mesh=box(HALF * 6)), features=None))
    moved = {**FACES, "top": {**FACES["top"], "point": [0, 0, 4.0]}}
    off = setting(small_scanner, features=features(features=moved))
    with pytest.raises(InputError, match="feature 'top'"):
        plan_part_scan(off)
    with pytest.raises(InputError, match="only"):
        plan_part_scan(setting(small_scanner, views=100_000))


@pytest.mark.slow
def test_what_no_view_shows_is_named_with_its_remedy(small_scanner):
    flat = default_travel()
    low, high = flat.low.copy(), flat.high.copy()
    low[2:6], high[2:6] = 0.0, 0.0
    mount = {"features": features(alignment={"start": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 12]]})}
    part = Part(mesh=box(centre=(0.0, 0.0, 12.0)))
    plan = plan_part_scan(
        setting(small_scanner, part=part, limits=ScanLimits(travel=TravelLimits(low=low, high=high)), **mount)
    )
    # 14.5 mm above the source's plane at 400 mm: rays come in at 2.1 deg, 0.6 deg too steep
    assert "tilt the fixture by" in plan.unseen["top"]
    assert plan.chosen.worth.seen["top"] < 0.1


def test_limits_that_contradict_themselves_or_are_misspelt_are_refused(tmp_path):
    path = tmp_path / "limits.toml"
    for text, match in (
        ("[travel]\nrx_deg = [5, -5]", "above its upper limit"),
        ("[travel]\nrx = [-5, 5]", "does not know rx"),
        ("[travel]\nrx_deg = 5", r"\[low, high\]"),
        ("[time]\nspeed_mm_s = 0", "positive"),
        ("[time]\nlimit_s = nan", "positive"),
        ('[keep_out]\ntube = {file = "tube.stl", frame = "M"}', "frame is 'M'"),
        ("[voltage]\nkv = 3", "voltage"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=match):
            read_limits(path)
    path.write_text("[travel]\nrx_deg = [-20, 15]\n[time]\nlimit_s = 600\n")
    limits = read_limits(path)
    assert np.degrees(limits.travel.high[3]) == pytest.approx(15.0)
    assert limits.time.limit == 600.0
    assert "rx_deg" not in limits.assumed
    assert "ry_deg" in limits.assumed


@pytest.mark.slow
def test_a_time_limit_leaves_out_the_least_useful_views(small_scanner):
    free = plan_part_scan(setting(small_scanner))
    limits = ScanLimits(time=type(ScanLimits().time)(limit=0.6 * free.chosen.duration))
    short = plan_part_scan(setting(small_scanner, limits=limits))
    assert short.dropped[0] > 0
    assert short.chosen.duration <= 0.6 * free.chosen.duration
    assert short.dropped[1] > 0


def hexapod(limits: tuple[float, float]) -> Hexapod:
    angle = np.radians([-10, 10, 110, 130, 230, 250])
    ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(6)])
    platform = np.radians([-50, 50, 70, 170, 190, 290])
    top = np.column_stack([np.cos(platform), np.sin(platform), np.zeros(6)])
    joints = {"base_joints": 120 * ring - [0, 0, 200.0], "platform_joints": 80 * top - [0, 0, 20.0]}
    return Hexapod(**joints, leg_limits=limits)


@pytest.mark.slow
def test_a_continuous_scan_is_one_smooth_turn_that_fdk_follows(small_scanner):
    plan = plan_part_scan(setting(small_scanner, views=24, continuous=True))
    assert path_obstacle(plan.matrices) == ""
    np.testing.assert_allclose(np.diff(plan.poses.alpha), 2 * math.pi / 24, atol=1e-9)
    assert plan.chosen.worth.J > plan.paths["circular"].worth.J
    assert plan.planned_J <= plan.bound
    low, high = plan.limits.travel.low[:6] - 1e-9, plan.limits.travel.high[:6] + 1e-9
    assert ((plan.way[:, :6] >= low) & (plan.way[:, :6] <= high)).all()
    # the way leads through the views
    for q in plan.chosen.q:
        assert np.abs(plan.way - q).max(axis=1).min() < math.radians(0.5)
    scattered = plan_part_scan(setting(small_scanner, views=24))
    assert path_obstacle(scattered.matrices) != ""


@pytest.mark.slow
def test_the_legs_of_a_hexapod_stay_within_their_stroke(small_scanner):
    machine = hexapod((100.0, 400.0))
    task = setting(small_scanner, manipulator=machine)
    free = plan_part_scan(task)
    T = free.poses.T_MH
    legs = machine.leg_lengths(T.R, T.t)
    home = machine.leg_lengths(np.eye(3)[None], np.zeros((1, 3)))
    stroke = 0.5 * float(np.abs(legs - home).max())
    narrow = hexapod((float(home.min()) - stroke, float(home.max()) + stroke))
    assert not narrow.reaches(T.R, T.t).all()
    T = plan_part_scan(setting(small_scanner, manipulator=narrow)).poses.T_MH
    assert narrow.reaches(T.R, T.t).all()
    assert (np.abs(narrow.leg_lengths(T.R, T.t) - home) <= stroke + np.ptp(home) + 1e-9).all()
    with pytest.raises(OutOfReachError, match="legs leave their stroke"):
        plan_part_scan(setting(small_scanner, manipulator=hexapod((10.0, 20.0))))


@pytest.mark.slow
def test_every_view_keeps_to_the_least_transmission_that_is_asked_for(small_scanner):
    task = setting(small_scanner)
    goal = task.goal()
    q, tables = task.candidates(goal)
    asked = float(np.quantile(tables.M, 0.6))
    dense = setting(small_scanner, settings=replace(task.settings, least_view_transmission=asked))
    kept, _ = dense.candidates(goal)
    assert len(kept) < len(q)
    plan = plan_part_scan(dense)
    assert table(goal, plan.machine.matrices(plan.chosen.q)).M.min() >= asked
    with pytest.raises(OutOfReachError, match="no view of"):
        setting(small_scanner, settings=replace(task.settings, least_view_transmission=0.999)).candidates(goal)


def test_a_box_in_the_limits_is_the_closed_mesh_of_its_corners(tmp_path):
    path = tmp_path / "limits.toml"
    path.write_text('[keep_out]\nplate = {box = [[-3, -2, -1], [3, 4, 5]], frame = "T"}\n')
    (found,) = read_limits(path).obstacles
    assert found.frame == "T"
    assert not found.mesh.open_edges
    a, b, c = (found.mesh.points[found.mesh.faces[:, k]] for k in range(3))
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6 == pytest.approx(6 * 6 * 6)
    for wrong in ("[[3, -2, -1], [-3, 4, 5]]", "[[0, 0], [1, 1]]", '"big"', "[[0, 0, nan], [1, 1, 1]]"):
        path.write_text(f"[keep_out]\nplate = {{box = {wrong}}}\n")
        with pytest.raises(InputError, match="box"):
            read_limits(path)
