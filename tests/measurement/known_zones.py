"""Sets of points whose minimum-zone, circumscribed or inscribed feature is known by construction.

A point at the distance delta from a surface, with foot x and outward unit normal n, comes nearer by n . v when the
surface changes with the velocity v(x).  A feature is a strict local optimum where a few points touch its bounds and
some positive weights w_i with signs s_i (outer +, inner -) make  sum w_i s_i n_i . v_k(x_i) = 0  for each change v_k
that the feature has, and no fewer points do.  So: put one point more than the feature has changes anywhere on it, take
the null vector of their n . v, and let its signs say which points lie outside and which inside.  All other points are
put strictly between.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

LEAST_WEIGHT, LEAST_SINGULAR = 0.01, 0.03


@dataclass(frozen=True)
class Known:
    """points (n, 3); the feature's point, direction, radius and half angle; half: half width of the zone;
    contacts: how many points determine it."""

    points: np.ndarray
    point: np.ndarray
    direction: np.ndarray
    radius: float
    half_angle: float
    half: float
    contacts: int


def surface_points(kind, rng, n, radius, psi):
    """Feet (n, 3), outward normals (n, 3) and n . v of the feature's changes (n, k), radius last but one for a cone."""
    angle, z = rng.uniform(0, 2 * np.pi, n), rng.uniform(-1.5, 1.5, n)
    e = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(n)])
    up = np.array([0.0, 0.0, 1.0])
    if kind == "plane":
        x = np.column_stack([rng.uniform(-2, 2, (n, 2)), np.zeros(n)])
        normal = np.tile(up, (n, 1))
        motions = (up, None, None)
    elif kind == "sphere":
        cosine = rng.uniform(-1, 1, n)
        normal = e * np.sqrt(1 - cosine**2)[:, None] + np.outer(cosine, up)
        x = radius * normal
    elif kind == "cone":
        normal = np.cos(psi) * e - np.sin(psi) * up
        x = e * (radius + z * np.tan(psi))[:, None] + np.outer(z, up)
    else:
        z = np.zeros(n) if kind == "circle" else z
        normal, x = e, radius * e + np.outer(z, up)
    shifts = {"plane": [2], "circle": [0, 1], "sphere": [0, 1, 2]}.get(kind, [0, 1])
    turns = {"circle": [], "sphere": []}.get(kind, [0, 1])
    motions = [normal[:, k] for k in shifts]
    motions += [np.einsum("ij,ij->i", normal, np.cross(np.eye(3)[k], x)) for k in turns]
    growth = []
    if kind in ("circle", "sphere", "cylinder"):
        growth = [np.ones(n)]
    if kind == "cone":
        growth = [np.full(n, np.cos(psi)), z / np.cos(psi)]
    return x, normal, np.column_stack(motions + growth)


def random_turn(rng):
    q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    return q * np.sign(np.linalg.det(q))


def weights_of(rows):
    """The null vector of rows (k + 1, k), scaled to sum of sizes 1; None where it is not well determined."""
    _, singular, vectors = np.linalg.svd(rows.T)
    w = vectors[-1] / np.abs(vectors[-1]).sum()
    return None if np.abs(w).min() < LEAST_WEIGHT or singular[-1] < LEAST_SINGULAR else w


def known_set(kind, criterion, seed, n=80):
    """A set of n points with its contacts, in any order and anywhere in space."""
    rng = np.random.default_rng([seed, len(kind), len(criterion)])
    radius, psi = rng.uniform(0.8, 2.5), rng.uniform(0.15, 0.6) if kind == "cone" else 0.0
    if kind == "cone":
        radius = 1.5 * np.tan(psi) + rng.uniform(0.4, 1.5)
    half = rng.uniform(0.002, 0.02)
    of_radius = kind == "line" or criterion != "minimum-zone"
    if kind == "line":
        radius = half
    while True:
        k = surface_points(kind, rng, 1, radius, psi)[2].shape[1]
        # Bounded by the radius itself, a feature has no change of radius of its own.
        k -= of_radius and kind != "line"
        x, normal, rows = surface_points(kind, rng, k + 1, radius, psi)
        w = weights_of(rows[:, :k])
        if w is not None and (not of_radius or (w > 0).all() or (w < 0).all()):
            break
    m = k + 1
    side = np.zeros(m) if of_radius else half * np.sign(w)
    inner, normals, _ = surface_points(kind, rng, n - m, radius, psi)
    share = rng.uniform(-0.85, 0.85, n - m)
    if kind == "line":
        offset = -half * rng.uniform(0.1, 1.0, n - m)
    elif criterion == "minimum-circumscribed":
        offset = -half * (1 + share)
    elif criterion == "maximum-inscribed":
        offset = half * (1 + share)
    else:
        offset = half * share
    points = np.vstack([x + side[:, None] * normal, inner + offset[:, None] * normals])
    half_width = np.ptp(np.concatenate([side, offset])) / 2 if of_radius and kind != "line" else half
    turn, shift = random_turn(rng), rng.uniform(-40, 40, 3)
    points = points[rng.permutation(n)] @ turn.T + shift
    return Known(
        points=points,
        point=shift,
        direction=turn[:, 2],
        radius=radius,
        half_angle=psi,
        half=half_width,
        contacts=m,
    )


def pairs_set(kind, seed, n=80):
    """Smallest circle or sphere held by two opposite points: fewer contacts than changes, and bounded by the curvature
    of the distances alone."""
    rng = np.random.default_rng([seed, 77])
    radius, half = rng.uniform(0.8, 2.5), rng.uniform(0.002, 0.02)
    angle = rng.uniform(0, 2 * np.pi)
    angles = np.array([angle, angle + np.pi])
    ends = np.column_stack([radius * np.cos(angles), radius * np.sin(angles), np.zeros(2)])
    inner, normals, _ = surface_points(kind, rng, n - len(ends), radius, 0.0)
    points = np.vstack([ends, inner - half * (1 + rng.uniform(-0.85, 0.85, n - len(ends)))[:, None] * normals])
    depth = radius - np.min(np.linalg.norm(points if kind == "sphere" else points[:, :2], axis=1))
    turn, shift = random_turn(rng), rng.uniform(-40, 40, 3)
    return Known(
        points=points @ turn.T + shift,
        point=shift,
        direction=turn[:, 2],
        radius=radius,
        half_angle=0.0,
        half=depth / 2,
        contacts=len(ends),
    )
