"""Path lengths against counted steps along the ray, and against closed forms to 1 nm."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tomopose.errors import InputError
from tomopose.geometry.frames import Frame
from tomopose.simulation.objects.shapes import Solid, box, cone, cylinder, half_space, sphere, torus, union
from tomopose.simulation.projector.rays import compile_solids, path_lengths

NANOMETRE = 1e-6
STEP = 2e-3


def radial(x):
    return np.hypot(x[..., 0], x[..., 1])


CASES = {
    "sphere": (sphere(4), lambda x: (x**2).sum(-1) < 16),
    "cylinder": (cylinder(3, -4, 5), lambda x: (radial(x) < 3) & (x[..., 2] > -4) & (x[..., 2] < 5)),
    "cone": (cone(3, 1, -2, 3), lambda x: (radial(x) < 3 - 2 * (x[..., 2] + 2) / 5) & (abs(x[..., 2] - 0.5) < 2.5)),
    "pointed cone": (cone(0, 4, -2, 1), lambda x: (radial(x) < 4 * (x[..., 2] + 2) / 3) & (abs(x[..., 2] + 0.5) < 1.5)),
    "box": (box(3, 4, 5), lambda x: (abs(x) < [1.5, 2, 2.5]).all(-1)),
    "torus": (torus(4, 1.2), lambda x: (radial(x) - 4) ** 2 + x[..., 2] ** 2 < 1.44),
    "cut sphere": (
        sphere(4) & half_space().along([1, 2, 3], t=[0.3, 0.2, 0.1]),
        lambda x: ((x**2).sum(-1) < 16) & ((x - [0.3, 0.2, 0.1]) @ [1, 2, 3] < 0),
    ),
    "bored block": (
        (box(6, 6, 6) - cylinder(2, -5, 5) - torus(3, 0.7)) | sphere(1),
        lambda x: (
            ((abs(x) < 3).all(-1) & (radial(x) >= 2) & ((radial(x) - 3) ** 2 + x[..., 2] ** 2 >= 0.49))
            | ((x**2).sum(-1) < 1)
        ),
    ),
}


def rays(rng, n=150):
    o = np.array([300.0, 0.0, 0.0]) + rng.normal(size=(n, 3))
    d = rng.normal(size=(n, 3)) * 3 - o
    return o, d / np.linalg.norm(d, axis=1, keepdims=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_paths_are_what_counting_along_the_ray_gives(name, rng):
    shape, inside = CASES[name]
    R, t = Rotation.from_rotvec(rng.normal(size=3)).as_matrix(), rng.normal(size=3)
    o, d = rays(rng)
    L = path_lengths([Solid(shape=shape.placed(R=R, t=t), material="Al")], o, d)[:, 0]
    steps = np.arange(280, 325, STEP) + STEP / 2
    counted = inside((o[:, None] + steps[:, None] * d[:, None] - t) @ R).sum(1) * STEP
    assert (L > 0).mean() > 0.1
    np.testing.assert_allclose(L, counted, atol=4 * STEP)


def test_sphere_at_grazing_incidence_to_a_nanometre():
    from decimal import Decimal, getcontext

    getcontext().prec = 50
    r, z = 4.0, 283.5
    for b in (0.0, 1.0, 3.9, 3.999, 3.9999999, 3.999999999):
        # A ray from the origin that passes (0, 0, z) at distance b has the direction (b, 0, sqrt(z^2-b^2)).
        d = np.array([b, 0.0, np.sqrt(z * z - b * b)])
        d /= np.linalg.norm(d)
        x, y = Decimal(float(d[0])), Decimal(float(d[2]))
        along = y * Decimal(z) / (x * x + y * y).sqrt()
        exact = float(2 * (Decimal(r) ** 2 - (Decimal(z) ** 2 - along**2)).max(Decimal(0)).sqrt())
        L = path_lengths([Solid(shape=sphere(r).placed(t=[0, 0, z]), material="Al")], np.zeros(3), d[None])[0, 0]
        assert abs(L - exact) < NANOMETRE


def test_chords_of_a_torus_and_a_cone_to_a_nanometre():
    o = np.array([[300.0, 0.0, 0.0], [300.0, 4.0, 0.3]])
    d = np.array([[-1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    ring = path_lengths([Solid(shape=torus(4, 1.2), material="Al")], o, d)[:, 0]
    tube = np.sqrt(1.44 - 0.09)
    exact = 2 * np.sqrt((4 + tube) ** 2 - 16)  # the inner circle, radius 4 - tube, is not met at y = 4
    np.testing.assert_allclose(ring, [4.8, exact], atol=NANOMETRE)
    L = path_lengths([Solid(shape=cone(3, 1, -2, 3), material="Al")], [300.0, 0.5, 0.5], [[-1.0, 0, 0]])[0, 0]
    assert abs(L - 2 * np.sqrt(4 - 0.25)) < NANOMETRE


def test_later_solids_displace_earlier_ones(rng):
    tube = Solid(shape=cylinder(6, -15, 0), material="PEEK")
    ball = Solid(shape=sphere(4), material="WC-Co")
    o, d = rays(rng)
    both = path_lengths([tube, ball], o, d)
    cut = path_lengths([Solid(shape=cylinder(6, -15, 0) - sphere(4), material="PEEK"), ball], o, d)
    np.testing.assert_allclose(both, cut, atol=NANOMETRE)
    joined = path_lengths([Solid(shape=cylinder(6, -15, 0) | sphere(4), material="PEEK")], o, d)[:, 0]
    np.testing.assert_allclose(both.sum(axis=1), joined, atol=NANOMETRE)


def test_a_union_of_many_shapes_needs_no_deep_stack(rng):
    balls = [sphere(1).placed(t=x) for x in rng.normal(size=(30, 3)) * 3]
    o, d = rays(rng)
    compiled = compile_solids([Solid(shape=union(balls), material="Al")])
    assert compiled.depth <= 7
    separate = path_lengths([Solid(shape=b, material="Al") for b in balls], o, d)
    np.testing.assert_allclose(path_lengths(compiled, o, d), separate, atol=NANOMETRE)


def test_what_lies_behind_the_source_casts_no_shadow():
    solids = [Solid(shape=sphere(4), material="Al")]
    assert path_lengths(solids, [0.0, 0.0, 0.0], [[1.0, 0.0, 0.0]])[0, 0] == pytest.approx(4.0)
    assert path_lengths(solids, [5.0, 0.0, 0.0], [[1.0, 0.0, 0.0]])[0, 0] == 0.0


def test_too_many_crossings_are_an_error_and_no_wrong_path():
    comb = union([box(0.1, 1, 1).placed(t=[0.2 * k, 0, 0]) for k in range(40)])
    with pytest.raises(InputError, match="more than 48 surfaces"):
        path_lengths([Solid(shape=comb, material="Al")], [100.0, 0, 0], [[-1.0, 0, 0]])


@pytest.mark.parametrize(
    "make",
    [
        lambda: sphere(0),
        lambda: cylinder(1, 2, 2),
        lambda: cone(-1, 1, 0, 1),
        lambda: box(1, -1, 1),
        lambda: torus(1, 1),
        lambda: sphere(1).along([0, 0, 0]),
        lambda: union([]),
        lambda: Solid(shape=half_space(), material="Al"),
        lambda: Solid(shape=sphere(1), material="Al", frame=Frame.D),
        lambda: compile_solids([]),
    ],
)
def test_impossible_shapes_are_refused(make):
    with pytest.raises(InputError):
        make()
