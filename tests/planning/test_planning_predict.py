"""The predicted uncertainty: against SART itself with noise, and against what is known of fits."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csr_array

import tomopose as tp
from tomopose.engines.cpu import CpuEngine
from tomopose.geometry.box import BOX_CORNERS
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.measurement.mesh.mesh import Mesh
from tomopose.measurement.plan import plan_from
from tomopose.measurement.surface.splines import spline_coefficients
from tomopose.planning.part import sart_steps as sart_steps_module
from tomopose.planning.part.part import Part
from tomopose.planning.part.predict import _lengths, _slopes, predicted
from tomopose.planning.part.sart_response import RELAXATION, Blocks, blocks, sart_response
from tomopose.planning.part.sart_steps import SartSteps, relaxed_per_length, sart_steps, weights_on_pixels
from tomopose.planning.part.settings import PartSettings
from tomopose.planning.part.targets import probed_targets
from tomopose.planning.part.worth import table
from tomopose.planning.part_scan.setting import Setting
from tomopose.reconstruction import updates
from tomopose.reconstruction.settings import SART

HALF = np.array([9.0, 7.0, 4.0])
VIEWS, SWEEPS = 15, 2
QUADS = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]


def box_part() -> Part:
    corners = np.array(list(itertools.product((-1, 1), (-1, 1), (-1, 1)))) * HALF
    faces = np.array([t for a, b, c, d in QUADS for t in ((a, b, c), (a, c, d))])
    mesh = Mesh(points=corners, faces=faces)
    outward = np.einsum("ij,ij->i", corners[faces].mean(axis=1), mesh.face_normals) > 0
    return Part(mesh=Mesh(points=corners, faces=np.where(outward[:, None], faces, faces[:, ::-1])))


def task(**changed: object) -> Setting:
    scanner = tp.Scanner(d_SD=1000.0, d_SR=400.0, p_u=1.6, p_v=1.5, u_0=23.3, v_0=20.1, n_u=47, n_v=43)
    settings = PartSettings(mu=0.05, sweeps=SWEEPS, room=4.0, quanta=2.0e4)
    return Setting(**{"scanner": scanner, "part": box_part(), "views": VIEWS, "settings": settings, **changed})


def tilted_turn(setting: Setting) -> np.ndarray:
    q = np.zeros((VIEWS, 7))
    q[:, 6] = np.arange(VIEWS) * 2 * np.pi / VIEWS
    q[:, 3], q[:, 4] = np.radians(10 * np.sin(3 * q[:, 6])), np.radians(10 * np.cos(3 * q[:, 6]))
    return setting.machine.matrices(q)


@pytest.mark.slow
def test_the_noise_of_sums_over_a_volume_is_that_of_sart(rng):
    """White noise of the line integrals through `reconstruct`; sums over a voxel, a face's patch and a column."""
    setting = task()
    P, s = tilted_turn(setting), setting.scanner
    spacing = s.p_u * s.d_SR / s.d_SD
    n = np.ceil((2 * HALF + 2 * setting.settings.room) / spacing).astype(int)
    grid = tp.VoxelGrid((int(n[2]), int(n[1]), int(n[0])), spacing, np.zeros(3))
    names = tuple(str(j) for j in range(VIEWS))
    matrices = ProjectionMatrices(P=P, n_u=s.n_u, n_v=s.n_v, p_u=s.p_u, p_v=s.p_v, pose_id=names, scanner=s)
    sigma = 0.01
    steps = np.arange(-3, 4) * spacing
    u, v = (w.ravel() for w in np.meshgrid(steps, steps))
    zero = np.zeros_like(u)
    sums = [np.column_stack([u, v, zero + HALF[2]]), np.column_stack([zero + HALF[0], u, v])]
    sums.append(np.column_stack([0 * steps, 0 * steps, steps]))
    values = []
    for _ in range(40):
        images = rng.normal(0, sigma, (VIEWS, s.n_v, s.n_u)).astype(np.float32)
        volume = tp.reconstruct(
            images,
            matrices,
            grid,
            images_are="line-integrals",
            algorithm=SART(iterations=SWEEPS),
            engine="cpu",
            consistency="off",
        )
        nearest = [np.rint(grid.indices(x)).astype(int) for x in sums]
        values.append([volume.values[i[:, 0], i[:, 1], i[:, 2]].mean() for i in nearest])
    achieved = np.std(values, axis=0, ddof=1)
    response = sart_response(setting.part, s, P, setting.settings)
    response = replace(response, variance=np.full_like(response.variance, sigma**2))
    first = np.cumsum([0, *(len(x) for x in sums)])
    weights = np.zeros((3, first[-1]))
    for k, x in enumerate(sums):
        weights[k, first[k] : first[k + 1]] = 1 / len(x)
    expected = np.sqrt(np.diag(response.covariance(np.concatenate(sums), csr_array(weights))))
    # a standard deviation of 40 draws is uncertain by 11 %; the filters take planes of Fourier space as separate
    np.testing.assert_allclose(expected / achieved, 1.0, atol=0.35)


def test_the_steps_of_sart_backwards_are_the_transpose_of_reconstruct(rng):
    """c . x = g . p for the volume x that `reconstruct` makes of any line integrals p, the box beyond the panel too."""
    setting = task()
    P, s = tilted_turn(setting), setting.scanner
    # 36 x 32 x 20 mm: its corners leave the panel in some views
    box = tp.VoxelGrid((31, 50, 56), s.p_u * s.d_SR / s.d_SD, np.array([0.3, -0.2, 0.1]))
    names = tuple(str(j) for j in range(VIEWS))
    matrices = ProjectionMatrices(P=P, n_u=s.n_u, n_v=s.n_v, p_u=s.p_u, p_v=s.p_v, pose_id=names, scanner=s)
    p = rng.normal(0, 0.01, (VIEWS, s.n_v, s.n_u)).astype(np.float32)
    volume = tp.reconstruct(
        p,
        matrices,
        box,
        images_are="line-integrals",
        algorithm=SART(iterations=SWEEPS),
        engine="cpu",
        consistency="off",
    )
    scale = float(np.sqrt(np.mean(volume.values**2)))
    for c in (rng.normal(size=box.shape), np.eye(1, box.size, box.size // 3).reshape(box.shape)):
        g = weights_on_pixels(matrices, box, c, SWEEPS, relaxed_per_length(CpuEngine(matrices, box)))
        assert np.vdot(g, p) == pytest.approx(np.vdot(c, volume.values), abs=1e-3 * scale * np.linalg.norm(c))


def test_sart_step_by_step_is_reconstruct_and_both_leave_out_the_same_rays():
    setting = task()
    steps = sart_steps(setting.part, setting.scanner, tilted_turn(setting), setting.settings)
    L = -np.log(blocks_of(setting).tau)
    how = {"images_are": "line-integrals", "engine": "cpu", "consistency": "off"}
    found = tp.reconstruct(L, steps.matrices, steps.box, algorithm=SART(iterations=SWEEPS), **how)
    np.testing.assert_allclose(steps.coefficients, spline_coefficients(found.values), atol=2e-5)
    assert sart_steps_module.per_length is updates.per_length
    x = steps.box.points(np.array([[5, 6, 7], [8, 9, 10]]))
    np.testing.assert_allclose(steps.at(x), [found.values[5, 6, 7], found.values[8, 9, 10]], atol=2e-5)


def blocks_of(setting: Setting) -> Blocks:
    half = np.ptp(setting.part.mesh.points, axis=0) / 2 + setting.settings.room
    corners = setting.part.centre + half * BOX_CORNERS
    return blocks(setting.part, setting.scanner, tilted_turn(setting), setting.settings, corners=corners)


def test_the_exact_prediction_is_near_that_by_filters_and_falls_with_the_quanta():
    features = plan().model_copy(update={"features": {k: v for k, v in plan().features.items() if k != "ball"}})
    features = features.model_copy(update={"measurands": features.measurands[:1]})
    setting = task(features=features)
    P = tilted_turn(setting)

    def height(response: SartSteps | None = None, **changed: object) -> float:
        goal = replace(setting.goal(), settings=replace(setting.settings, **changed))
        return predicted(goal, setting.scanner, P, table(goal, P), plan=features, response=response)[1]["height"]

    exact = height(uncertainty="exact")
    assert exact / height() == pytest.approx(1.0, abs=0.35)
    assert exact / height(uncertainty="exact", quanta=8.0e4) == pytest.approx(2.0, rel=1e-6)
    noisier = sart_steps(setting.part, setting.scanner, P, setting.settings)
    assert height(replace(noisier, variance=9 * noisier.variance)) == pytest.approx(3 * exact, rel=1e-6)


FEATURES = {
    "top": {"kind": "plane", "point": [-5, 0, 4], "direction": [0, 0, 1], "u": [2, 0, 0], "v": [0, 5, 0]},
    "bottom": {"kind": "plane", "point": [5, 0, -4], "direction": [0, 0, -1], "u": [2, 0, 0], "v": [0, 5, 0]},
    "ball": {"kind": "sphere", "point": [0, 0, 0], "radius_mm": 3.0},
}


def plan() -> tp.MeasurementPlan:
    rows = [
        {"name": "height", "kind": "distance", "of": ["top", "bottom"]},
        {"name": "D", "kind": "diameter", "of": ["ball"]},
    ]
    document = {"schema": "tomopose/measurement-plan/1", "unit": "mm", "features": FEATURES, "measurands": rows}
    return plan_from(document)


def test_the_prediction_and_the_reconstruction_relax_alike():
    assert SART().factors == (RELAXATION,)


def test_a_length_follows_the_edges_through_fit_and_lever():
    """Moving one end of the first plane tilts its normal, and the second plane's middle lies 10 mm beside it."""
    targets = probed_targets(plan(), 200)
    slopes = _slopes(targets, plan(), _lengths(targets, plan()))
    top, bottom, ball = targets
    tilt = 1e-3 * (top.x[:, 0] + 5)
    assert slopes["height"]["top"] @ tilt == pytest.approx(1e-3 * 10, rel=1e-6)
    assert slopes["height"]["top"] @ np.full(len(top.x), 1e-3) == pytest.approx(1e-3, rel=1e-6)
    assert slopes["height"]["bottom"] @ np.full(len(bottom.x), 1e-3) == pytest.approx(1e-3, rel=1e-6)
    assert slopes["D"]["ball"] @ np.full(len(ball.x), 1e-3) == pytest.approx(2e-3, rel=1e-6)


def test_a_distance_without_a_rule_is_left_to_the_measurement():
    """A cone and a plane have no distance; a circle and a plane have one."""
    cone = {"kind": "cone", "point": [0, 0, 0], "direction": [0, 0, 1], "radius_mm": 3, "length_mm": 4}
    circle = {"kind": "circle", "point": [0, 0, 1], "direction": [0, 0, 1], "radius_mm": 3.0}
    rows = [{"name": f"top to {k}", "kind": "distance", "of": ["top", k]} for k in ("cone", "circle")]
    given = {"top": FEATURES["top"], "cone": {**cone, "half_angle_deg": 10}, "circle": circle}
    document = {"schema": "tomopose/measurement-plan/1", "unit": "mm", "features": given, "measurands": rows}
    asked = plan_from(document)
    targets = probed_targets(asked, 60)
    wanted = _lengths(targets, asked)
    assert [m.name for m in wanted] == ["top to circle"]
    top = _slopes(targets, asked, wanted)["top to circle"]["top"]
    assert top @ np.full(len(targets[0].x), 1e-3) == pytest.approx(1e-3, rel=1e-6)


def test_four_times_the_quanta_halve_the_uncertainty():
    features = plan().model_copy(update={"features": {k: v for k, v in plan().features.items() if k != "ball"}})
    features = features.model_copy(update={"measurands": features.measurands[:1]})
    setting = task(features=features)
    P = tilted_turn(setting)
    u = []
    for quanta in (2e4, 8e4):
        goal = replace(setting.goal(), settings=replace(setting.settings, quanta=quanta))
        targets, lengths, _ = predicted(goal, setting.scanner, P, table(goal, P), plan=features)
        u.append([*(t.u for t in targets), lengths["height"]])
    assert all(math.isfinite(x) for x in u[0])
    np.testing.assert_allclose(np.array(u[0]) / u[1], 2.0, rtol=1e-6)
    # the calibration's share comes in quadrature
    shared = np.array([0.03, 0.04])
    with_own = predicted(goal, setting.scanner, P, table(goal, P), plan=features, shared=shared)[1]["height"]
    assert with_own == pytest.approx(math.hypot(u[1][-1], 0.05), rel=1e-9)
