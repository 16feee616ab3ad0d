"""A mesh of smaller triangles on the same surface: vertices where a comparison or a probed point needs them.

Edges longer than wanted are halved, in all triangles that share them, until none is left; a triangle with one, two or
three halved edges becomes two, three or four.  A flat triangle stays flat, so nothing of the geometry changes.
"""

from __future__ import annotations

import numpy as np

from tomopose.errors import InputError
from tomopose.measurement.mesh.mesh import Mesh

MOST_TRIANGLES = 20_000_000


def refined(mesh: Mesh, edge: float) -> Mesh:
    """The mesh with no edge longer than `edge`, mm.

    The reference of paper sec. 6.2 has edges of about 0.1 mm.  InputError where it would take too many triangles.
    """
    if not edge > 0:
        raise InputError(f"the edge length is {edge} mm; a positive length is needed")
    area = 0.5 * float(np.linalg.norm(mesh.face_normals, axis=1).sum())
    expected = max(2.5 * area / edge**2, len(mesh.faces))
    if expected > MOST_TRIANGLES:
        raise InputError(f"edges of {edge:g} mm would take about {expected:.2g} triangles; give a longer edge")
    points, faces = np.array(mesh.points), np.array(mesh.faces)
    while True:
        ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1), axis=-1)
        long = np.linalg.norm(points[ends[..., 1]] - points[ends[..., 0]], axis=-1) > edge
        if not long.any():
            return Mesh(points=points, faces=faces)
        key = ends[..., 0].astype(np.int64) * len(points) + ends[..., 1]
        halved, number = np.unique(key[long], return_inverse=True)
        middle = np.full(faces.shape, -1)
        middle[long] = len(points) + number
        new = 0.5 * (points[halved // len(points)] + points[halved % len(points)])
        points = np.concatenate([points, new])
        faces = _divided(faces, middle, points)


def _divided(faces: np.ndarray, middle: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Triangles (m, 3) whose edges ab, bc, ca have the new middle points (m, 3), -1 for none."""
    count = (middle >= 0).sum(axis=1)
    # Turned so that one halved edge is ab, and two are ab and bc.
    first = np.where(count == 2, (np.argmin(middle, axis=1) + 1) % 3, np.argmax(middle >= 0, axis=1))
    order = (first[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(faces, order, axis=1).T
    ab, bc, ca = np.take_along_axis(middle, order, axis=1).T

    def rows(which: np.ndarray, *triangles: tuple[np.ndarray, np.ndarray, np.ndarray]) -> list[np.ndarray]:
        return [np.column_stack([v[which] for v in t]) for t in triangles]

    one, two, three = (np.flatnonzero(count == k) for k in (1, 2, 3))
    # Of the two diagonals of the quadrilateral a, ab, bc, c that two halved edges leave, the shorter.
    far = np.linalg.norm(points[a] - points[bc], axis=1) <= np.linalg.norm(points[ab] - points[c], axis=1)
    by_a, by_c = two[far[two]], two[~far[two]]
    return np.concatenate(
        [
            faces[count == 0],
            *rows(one, (a, ab, c), (ab, b, c)),
            *rows(two, (ab, b, bc)),
            *rows(by_a, (a, ab, bc), (a, bc, c)),
            *rows(by_c, (a, ab, c), (ab, bc, c)),
            *rows(three, (a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)),
        ]
    )
