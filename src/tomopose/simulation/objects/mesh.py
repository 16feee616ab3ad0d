"""Triangle meshes: path lengths through closed surfaces, by embreex with every hit computed again in float64.

Embree finds which triangles a ray meets, in float32; where it meets them is computed here from the triangle's
plane.  The signs of entries and exits must cancel along each ray; a ray where they do not has slipped through a
shared edge and is shot again a millionth of the mesh's radius beside itself, for it would give a path as long as
the object.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tomopose.errors import EngineFailedError, EngineMissingError, FileError, InputError, ShapeError
from tomopose.geometry.frames import Frame
from tomopose.provenance import sha256
from tomopose.reading import reader
from tomopose.units import Array

INSTALL = 'pip install "tomopose[sim]"'
STEP = 2e-5
"""How far behind a hit the next search begins, mm: five roundings of float32 at 35 mm, and far below any wall."""
MOST_HITS = 128
RETRIES = 16
"""Each moves the ray 1.3 times farther, from 1e-6 of the mesh's radius to 5e-5."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TriangleMesh:
    """vertices (n, 3), mm; faces (m, 3), counter-clockwise seen from outside; the surface is closed."""

    vertices: Array
    faces: Any

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices, dtype=np.float64)
        faces = np.ascontiguousarray(self.faces, dtype=np.int32)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
            raise ShapeError(f"a mesh needs vertices (n, 3) and faces (m, 3); got {vertices.shape} and {faces.shape}")
        if not np.isfinite(vertices).all() or faces.min() < 0 or faces.max() >= len(vertices):
            raise InputError("the mesh holds vertices that are not finite or faces of vertices that do not exist")
        vertices.setflags(write=False)
        faces.setflags(write=False)
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)

    @property
    def volume(self) -> float:
        """mm^3; negative where the faces look inwards."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)

    def require_closed(self) -> TriangleMesh:
        """This mesh, if every edge has two faces that agree on the outside; InputError otherwise."""
        edges = np.concatenate([self.faces[:, [0, 1]], self.faces[:, [1, 2]], self.faces[:, [2, 0]]]).astype(np.int64)
        n = len(self.vertices)
        there, back = np.sort(edges[:, 0] * n + edges[:, 1]), np.sort(edges[:, 1] * n + edges[:, 0])
        open_edges = int((there != back).sum()) if len(there) == len(back) else len(there)
        if open_edges or (np.diff(there) == 0).any():
            raise InputError("the mesh is not closed or its faces disagree on the outside; repair it first")
        if self.volume <= 0:
            raise InputError(f"the mesh's faces look inwards (volume {self.volume:g} mm^3); turn them round")
        return self

    def placed(self, *, R: ArrayLike | None = None, t: ArrayLike = (0.0, 0.0, 0.0)) -> TriangleMesh:
        """The mesh after x -> R x + t (mm)."""
        R = np.eye(3) if R is None else np.asarray(R, dtype=np.float64)
        return TriangleMesh(vertices=self.vertices @ R.T + np.asarray(t, dtype=np.float64), faces=self.faces)

    def refined(self) -> TriangleMesh:
        """Every triangle cut in four."""
        n = len(self.vertices)
        pairs = np.sort(np.concatenate([self.faces[:, [0, 1]], self.faces[:, [1, 2]], self.faces[:, [2, 0]]]), axis=1)
        unique, where = np.unique(pairs, axis=0, return_inverse=True)
        ab, bc, ca = (n + where.reshape(3, -1)).astype(np.int32)
        a, b, c = self.faces.T
        faces = np.concatenate([np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
        return TriangleMesh(vertices=np.concatenate([self.vertices, self.vertices[unique].mean(axis=1)]), faces=faces)


@dataclass(frozen=True, kw_only=True, eq=False)
class MeshSolid:
    """A closed mesh filled with a material and fixed to a frame: M, H, T or W.  Meshes must not overlap other
    solids."""

    mesh: TriangleMesh
    material: str
    frame: Frame = Frame.M
    name: str = ""
    _cache: dict[str, Any] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        self.mesh.require_closed()

    def __reduce__(self) -> tuple[object, tuple[Any, ...]]:
        # The search tree lives in C++ and is built anew in each process.
        return _mesh_solid, (self.mesh, self.material, self.frame, self.name)

    @property
    def corners(self) -> Array:
        """(8, 3): corners of the mesh's box."""
        lo, hi = self.mesh.vertices.min(axis=0), self.mesh.vertices.max(axis=0)
        return np.array([[x, y, z] for x in (lo[0], hi[0]) for y in (lo[1], hi[1]) for z in (lo[2], hi[2])])

    @property
    def tracer(self) -> Tracer:
        if "tracer" not in self._cache:
            self._cache["tracer"] = Tracer(self.mesh)
        result: Tracer = self._cache["tracer"]
        return result


def _mesh_solid(mesh: TriangleMesh, material: str, frame: Frame, name: str) -> MeshSolid:
    return MeshSolid(mesh=mesh, material=material, frame=frame, name=name)


class Tracer:
    """The search tree of one mesh.  Coordinates are taken from the mesh's middle, so that float32 has small numbers."""

    def __init__(self, mesh: TriangleMesh) -> None:
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        except ImportError as error:
            raise EngineMissingError("meshes need embreex, which is not installed", install_line=INSTALL) from error
        self.middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
        self.radius = float(np.linalg.norm(mesh.vertices - self.middle, axis=1).max())
        local = mesh.vertices - self.middle
        a, b, c = (local[mesh.faces[:, k]] for k in range(3))
        self.normal = np.cross(b - a, c - a)
        self.offset = np.einsum("ij,ij->i", self.normal, a)
        self.scene = EmbreeScene()
        TriangleMesh(scene=self.scene, vertices=local.astype(np.float32), indices=np.array(mesh.faces))

    def paths(self, o: Array, d: Array) -> tuple[Array, Any]:
        """(path lengths (n,), mm; numbers of hits (n,)) of rays from o (n, 3) along unit directions d (n, 3), in the
        mesh's own coordinates."""
        o = o - self.middle
        along = -np.einsum("ij,ij->i", o, d)
        start = o + along[:, None] * d
        near = np.einsum("ij,ij->i", start, start) < self.radius**2
        L, hits = np.zeros(len(o)), np.zeros(len(o), dtype=np.int64)
        index = np.flatnonzero(near)
        # Rays begin just outside the mesh, but never behind their source.
        first = np.maximum(-self.radius - 1.0, -along[index])
        L[index], hits[index], parity = self._shoot(start[index], d[index], first)
        again = index[parity != 0]
        for attempt in range(1, RETRIES + 1):
            if not len(again):
                return L, hits
            jitter = np.random.default_rng(np.random.SeedSequence([attempt, len(again)])).standard_normal(
                (len(again), 3)
            )
            moved = start[again] + 1e-6 * 1.3**attempt * self.radius * jitter
            first = np.maximum(-self.radius - 1.0, -along[again])
            L[again], hits[again], parity = self._shoot(moved, d[again], first)
            again = again[parity != 0]
        if len(again):
            raise EngineFailedError(
                f"{len(again)} rays enter and leave the mesh unequally often; it has a hole or crosses itself"
            )
        return L, hits

    def _shoot(self, o: Array, d: Array, first: Array) -> tuple[Array, Any, Any]:
        n = len(o)
        L, hits, parity = np.zeros(n), np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
        live, begin = np.arange(n), first.copy()
        d_32 = d.astype(np.float32)
        last = np.full(n, -1)
        for _ in range(MOST_HITS):
            if not len(live):
                break
            origin = (o[live] + begin[live, None] * d[live]).astype(np.float32)
            found = self.scene.run(origin, d_32[live], output=True)
            face = found["primID"]
            met = face >= 0
            live, face, reach = live[met], face[met], found["tfar"][met].astype(np.float64)
            slope = np.einsum("ij,ij->i", self.normal[face], d[live])
            with np.errstate(divide="ignore", invalid="ignore"):
                t = (self.offset[face] - np.einsum("ij,ij->i", self.normal[face], o[live])) / slope
            # A ray within the triangle's plane has no crossing of its own: float32's place is kept.
            t = np.where(
                np.isfinite(t) & (np.abs(t - begin[live] - reach) < 0.01 + 1e-3 * np.abs(reach)), t, begin[live] + reach
            )
            new = face != last[live]
            sign = np.sign(slope).astype(np.int64)
            L[live] += np.where(new, sign * t, 0.0)
            parity[live] += np.where(new, sign, 0)
            hits[live] += new
            last[live] = face
            begin[live] += reach + STEP
        return L, hits, parity


def mesh_paths(solid: MeshSolid, o: Array, d: Array) -> Array:
    """Path lengths (n,), mm, of rays o (3,) or (n, 3), d (n, 3) in the solid's own frame."""
    d = np.atleast_2d(np.asarray(d, dtype=np.float64))
    d = d / np.linalg.norm(d, axis=1, keepdims=True)
    return solid.tracer.paths(np.broadcast_to(np.asarray(o, dtype=np.float64), d.shape), d)[0]


@functools.lru_cache(maxsize=4)
def _load(path: str, scale: float, digest: str) -> TriangleMesh:
    """The mesh of a file whose content has this digest: a file that is written anew is read anew."""
    try:
        import trimesh
    except ImportError as error:
        raise EngineMissingError("mesh files need trimesh, which is not installed", install_line=INSTALL) from error
    try:
        loaded: Any = trimesh.load(path, force="mesh", process=True)
    except Exception as error:
        raise FileError(f"{path} cannot be read as a mesh: {error}", path=path) from error
    return TriangleMesh(vertices=np.asarray(loaded.vertices) * scale, faces=np.asarray(loaded.faces)).require_closed()


@reader("mesh")
def read_mesh(path: str | Path, *, scale: float = 1.0) -> TriangleMesh:
    """A closed triangle mesh from an STL, PLY or OBJ file; scale: mm per unit of the file."""
    return _load(str(path), scale, sha256(path))


def write_stl(path: str | Path, mesh: TriangleMesh) -> None:
    """Binary STL, atomically."""
    from tomopose.files import atomic_file

    record = np.zeros(len(mesh.faces), dtype=[("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")])
    corners = mesh.vertices[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    record["n"] = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    record["v"] = corners
    with atomic_file(path) as temporary:
        temporary.write_bytes(b"tomopose, mm".ljust(80) + np.uint32(len(record)).tobytes() + record.tobytes())
