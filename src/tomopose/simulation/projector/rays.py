"""Exact path lengths of rays through solids made of primitives: interval lists along the ray, in float64.

A ray is s + t d with |d| = 1.  Every primitive gives the sorted list of distances t at which its surface is
crossed, with the number of the surface crossed; Boolean operations merge two such lists by sweeping along the ray.
Before any quadratic is solved, the ray's origin is moved to the point nearest to the primitive, so that no small
number is the difference of two
large ones: the error of a path stays below 1 nm even at grazing incidence.
"""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike

from tomopose.errors import InputError
from tomopose.geometry.frames import Frame
from tomopose.geometry.transforms import RigidTransform
from tomopose.kernel_cache import njit
from tomopose.simulation.objects.shapes import Joined, Primitive, Shape, Solid
from tomopose.simulation.projector.crossings import crossings
from tomopose.simulation.projector.view import in_bands
from tomopose.units import Array
from tomopose.values import value

BUNDLE = 32
"""Rays that are looked at together, to find which solids they can meet at all."""
LARGEST = 48
"""Most surface crossings on one ray inside one solid; a ray that needs more is an error, never a wrong path."""
ROW_0, UNION, INTERSECTION, DIFFERENCE = (cast(int, np.int64(k)) for k in (0, -1, -2, -3))
"""A row of crossings, and how two are combined.  numba compiles a function anew for each plain number that it is called
with; these are values like any other."""


class SolidArrays(NamedTuple):
    """`Compiled` in one frame, in few arrays: each array that goes from kernel to kernel costs compile time.

    primitives (n, 16): p, t, R by rows and kind; ops: as in `Compiled`; runs (m, 3): first op of each solid, the one
    after its last, its material; spheres (m, 4): centre and radius.
    """

    primitives: Array
    ops: np.ndarray
    runs: np.ndarray
    spheres: Array


@value
class Compiled:
    """Solids as flat arrays, each primitive in the frame of its solid.

    kind (n,), p (n, 3), R (n, 3, 3), t (n, 3): primitives, x_local = R' (x - t).  ops: postfix programs, first[k] to
    first[k + 1] for solid k: a primitive's number, or -1 union, -2 intersection, -3 difference.  material (m,): index
    into `materials`.  centre (m, 3), radius (m,): bounding spheres.  frame (m,), solid (n,): whose frame, whose
    primitive.  corners: m arrays (k, 3) of points whose convex hull holds the solid.  smallest: half the shortest side
    of any primitive, mm.
    """

    kind: np.ndarray
    p: Array
    R: Array
    t: Array
    ops: np.ndarray
    first: np.ndarray
    material: np.ndarray
    materials: tuple[str, ...]
    centre: Array
    radius: Array
    frame: tuple[Frame, ...]
    solid: np.ndarray
    corners: tuple[Array, ...]
    smallest: float
    depth: int

    def arrays(self, T_FW: dict[Frame, RigidTransform] | None) -> SolidArrays:
        """What the kernels take, in W, or in the frame that all solids share where T_FW is None."""
        R, t, centre = (self.R, self.t, self.centre) if T_FW is None else self.in_world(T_FW)
        return SolidArrays(
            primitives=np.column_stack([self.p, t, R.reshape(-1, 9), self.kind]),
            ops=self.ops,
            runs=np.stack([self.first[:-1], self.first[1:], self.material], axis=1),
            spheres=np.column_stack([centre, self.radius]),
        )

    def in_world(self, T_FW: dict[Frame, RigidTransform]) -> tuple[Array, Array, Array]:
        """(R, t, centre) of primitives and bounding spheres in W, for one pose's frame-to-world transforms."""
        R, t, centre = self.R.copy(), self.t.copy(), self.centre.copy()
        for frame in set(self.frame):
            T = T_FW[frame]
            mine = np.array([f is frame for f in self.frame])
            primitives = mine[self.solid]
            R[primitives] = T.R @ R[primitives]
            t[primitives] = t[primitives] @ T.R.T + T.t
            centre[mine] = centre[mine] @ T.R.T + T.t
        return R, t, centre


def _postfix(shape: Shape, out: list[Primitive], ops: list[int]) -> int:
    """Append the shape's program; return the stack depth that it needs."""
    if isinstance(shape, Primitive):
        ops.append(len(out))
        out.append(shape)
        return 1
    assert isinstance(shape, Joined)
    a = _postfix(shape.a, out, ops)
    b = _postfix(shape.b, out, ops)
    ops.append(shape.op)
    return max(a, 1 + b)


def compile_solids(solids: list[Solid] | tuple[Solid, ...]) -> Compiled:
    """Solids as arrays for the kernels."""
    if not solids:
        raise InputError("there is nothing to image: the list of solids is empty")
    primitives: list[Primitive] = []
    ops: list[int] = []
    first, owner, depth = [0], [], 1
    for k, solid in enumerate(solids):
        before = len(primitives)
        depth = max(depth, _postfix(solid.shape, primitives, ops))
        owner += [k] * (len(primitives) - before)
        first.append(len(ops))
    materials = tuple(dict.fromkeys(s.material for s in solids))
    bounds = [s.shape.bound() for s in solids]
    return Compiled(
        kind=np.array([q.kind for q in primitives], dtype=np.int64),
        p=np.array([(*q.p, 0.0, 0.0, 0.0)[:3] for q in primitives]),
        R=np.array([q.R for q in primitives]),
        t=np.array([q.t for q in primitives]),
        ops=np.array(ops, dtype=np.int64),
        first=np.array(first, dtype=np.int64),
        material=np.array([materials.index(s.material) for s in solids], dtype=np.int64),
        materials=materials,
        centre=np.array([b[0] for b in bounds]),
        radius=np.array([b[1] for b in bounds]),
        frame=tuple(s.frame for s in solids),
        solid=np.array(owner, dtype=np.int64),
        corners=tuple(s.shape.corners() for s in solids),
        smallest=min(min(q.half) for q in primitives),
        depth=depth,
    )


@njit(cache=True, nogil=True)
def _combine(T: np.ndarray, S: np.ndarray, a: int, na: int, b: int, nb: int, op: int, out: int) -> int:
    """Merge rows a and b of crossings into row `out`: UNION, INTERSECTION or DIFFERENCE; -1 if too
    long."""
    i = j = n = 0
    in_a = in_b = inside = False
    while i < na or j < nb:
        if j >= nb or (i < na and T[a, i] <= T[b, j]):
            at, face = T[a, i], S[a, i]
            in_a = not in_a
            i += 1
        else:
            at, face = T[b, j], S[b, j]
            in_b = not in_b
            j += 1
        now = (in_a or in_b) if op == UNION else ((in_a and in_b) if op == INTERSECTION else (in_a and not in_b))
        if now != inside:
            inside = now
            if n > 0 and T[out, n - 1] == at:
                n -= 1
            else:
                if n >= LARGEST:
                    return -1
                T[out, n], S[out, n] = at, face
                n += 1
    return n


@njit(cache=True, nogil=True, inline="always")
def _solid_crossings(
    s: SolidArrays,
    k: int,
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    T: np.ndarray,
    S: np.ndarray,
) -> int:
    """Crossings of solid k, by its postfix program, into row 0 of T and S; their number, -1 where a list overflowed."""
    spare = T.shape[0] - 1
    top = n_now = ROW_0
    for q in range(s.runs[k, 0], s.runs[k, 1]):
        op = s.ops[q]
        if op >= 0:
            n_now = crossings(s.primitives, op, (ox, oy, oz), (dx, dy, dz), T, S, top)
            S[top, LARGEST] = n_now
            top += 1
            continue
        top -= 1
        n_a, n_b = S[top - 1, LARGEST], S[top, LARGEST]
        n_now = n_a
        if n_b == 0:
            if op == INTERSECTION:
                n_now = 0
        elif n_a == 0:
            if op == UNION:
                n_now = n_b
                for e in range(n_b):
                    T[top - 1, e], S[top - 1, e] = T[top, e], S[top, e]
        else:
            n_now = _combine(T, S, top - 1, n_a, top, n_b, op, spare)
            if n_now < 0:
                return -1
            for e in range(n_now):
                T[top - 1, e], S[top - 1, e] = T[spare, e], S[spare, e]
        S[top - 1, LARGEST] = n_now
    return n_now


@njit(cache=True, nogil=True, inline="always")
def _misses(s: SolidArrays, k: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float) -> bool:
    """Whether a ray passes the bounding sphere of solid k."""
    ex, ey, ez = s.spheres[k, 0] - ox, s.spheres[k, 1] - oy, s.spheres[k, 2] - oz
    along = ex * dx + ey * dy + ez * dz
    result: bool = ex * ex + ey * ey + ez * ez - along * along >= s.spheres[k, 3] * s.spheres[k, 3] * (1 + 1e-9) + 1e-9
    return result


@njit(cache=True, nogil=True)
def trace(
    s: SolidArrays,
    active: np.ndarray,
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    T: np.ndarray,
    S: np.ndarray,
    L: np.ndarray,
) -> Any:
    """Path lengths of one ray, per material, into L (mm); returns the ray's signature, or -1 where a list overflowed.

    active (m,): which solids can be met at all.  o, d: origin and unit direction.  T (depth + 3, LARGEST), S (the
    same, one column more) int64: work space.  The signature numbers the surfaces crossed in their order: rays that
    share it are joined by a smooth change of path.  S's last corner then holds how many solids were met.
    """
    for m in range(len(L)):
        L[m] = 0.0
    signature = np.int64(0)
    spare = T.shape[0] - 1
    met = 0
    taken, other, n_taken = T.shape[0] - 2, T.shape[0] - 3, ROW_0
    # Later solids displace earlier ones: walk backwards and keep what is taken already.
    for k in range(len(s.runs) - 1, -1, -1):
        if not active[k] or _misses(s, k, ox, oy, oz, dx, dy, dz):
            continue
        n_now = _solid_crossings(s, k, ox, oy, oz, dx, dy, dz, T, S)
        if n_now < 0:
            return np.int64(-1)
        if n_now == 0:
            continue
        met += 1
        row, n_row = ROW_0, n_now
        if n_taken > 0:
            row, n_row = spare, _combine(T, S, ROW_0, n_now, taken, n_taken, DIFFERENCE, spare)
            if n_row < 0:
                return np.int64(-1)
        path = 0.0
        for e in range(0, n_row, 2):
            path += max(T[row, e + 1], 0.0) - max(T[row, e], 0.0)
        for e in range(n_row):
            signature = (signature * np.int64(1000003) + S[row, e] + 1) & np.int64(0x7FFFFFFFFFFF)
        L[s.runs[k, 2]] += path
        if k > 0:
            n_taken = _combine(T, S, ROW_0, n_now, taken, n_taken, UNION, other)
            if n_taken < 0:
                return np.int64(-1)
            taken, other = other, taken
    S[spare, LARGEST] = met
    return signature


@njit(cache=True, nogil=True)
def _meet(spheres: np.ndarray, o: np.ndarray, d: np.ndarray, active: np.ndarray) -> None:
    """Mark the solids that a bundle of rays can meet.

    Rays within the angle a of an axis pass a point at distance e from their origin, p from the axis, no nearer than
    p cos(a) - e sin(a).
    """
    active[:] = True
    x = y = z = 0.0
    for i in range(len(d)):
        if o[i, 0] != o[0, 0] or o[i, 1] != o[0, 1] or o[i, 2] != o[0, 2]:
            return
        x, y, z = x + d[i, 0], y + d[i, 1], z + d[i, 2]
    length = np.sqrt(x * x + y * y + z * z)
    if length < 0.5 * len(d):
        return
    x, y, z = x / length, y / length, z / length
    cosine = 1.0
    for i in range(len(d)):
        cosine = min(cosine, x * d[i, 0] + y * d[i, 1] + z * d[i, 2])
    sine = np.sqrt(max(1 - cosine * cosine, 0.0)) + 1e-9
    for k in range(len(spheres)):
        ex, ey, ez = spheres[k, 0] - o[0, 0], spheres[k, 1] - o[0, 1], spheres[k, 2] - o[0, 2]
        along, square = ex * x + ey * y + ez * z, ex * ex + ey * ey + ez * ez
        active[k] = np.sqrt(max(square - along * along, 0.0)) * cosine - np.sqrt(square) * sine <= spheres[k, 3] + 1e-6


@njit(cache=True, nogil=True)
def _trace_all(s: SolidArrays, o: np.ndarray, d: np.ndarray, depth: int, lo: int, hi: int, L: np.ndarray) -> int:
    """Path lengths of rays lo to hi into L; returns the number of a ray whose list overflowed, or -1."""
    T, S = np.empty((depth + 3, LARGEST)), np.empty((depth + 3, LARGEST + 1), dtype=np.int64)
    active = np.ones(len(s.runs), dtype=np.bool_)
    for i in range(lo, hi):
        if (i - lo) % BUNDLE == 0:
            _meet(s.spheres, o[i : min(i + BUNDLE, hi)], d[i : min(i + BUNDLE, hi)], active)
        if trace(s, active, o[i, 0], o[i, 1], o[i, 2], d[i, 0], d[i, 1], d[i, 2], T, S, L[i]) < 0:
            return i
    return -1


def path_lengths(
    solids: Compiled | list[Solid],
    o: ArrayLike,
    d: ArrayLike,
    T_FW: dict[Frame, RigidTransform] | None = None,
    *,
    threads: int = 1,
) -> Array:
    """Path lengths (n, m), mm, of rays in each of the m materials.

    o: origins (n, 3) or (3,), mm; d: directions (n, 3), any length; both in W, or, where T_FW is None, in the frame
    that all solids share.  Only the ray's part in front of its origin counts.  Neighbours in the list that are
    neighbours in space are traced faster.
    """
    compiled = solids if isinstance(solids, Compiled) else compile_solids(solids)
    solid_arrays = compiled.arrays(T_FW)
    d = np.atleast_2d(np.asarray(d, dtype=np.float64))
    d = np.ascontiguousarray(d / np.sqrt(np.einsum("ij,ij->i", d, d))[:, None])
    o = np.broadcast_to(np.asarray(o, dtype=np.float64), d.shape)
    L = np.zeros((len(d), len(compiled.materials)))
    bad = [-1]

    def some(lo: int, hi: int) -> None:
        found = _trace_all(solid_arrays, o, d, compiled.depth, lo, hi, L)
        if found >= 0:
            bad[0] = found

    in_bands(some, len(d), threads)
    if bad[0] >= 0:
        raise InputError(f"ray {bad[0]} crosses more than {LARGEST} surfaces of one solid; split the solid in several")
    return L
