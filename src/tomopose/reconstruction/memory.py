"""What a reconstruction needs in memory, and into how many slabs it has to be cut."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path

from tomopose.engines.layout import MARGIN
from tomopose.errors import InputError
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.volume import VoxelGrid

GIB = 2**30
IMAGE_COPIES = 8
"""float32 images alive for each view of a subset: this one, the next, reprojection, lengths, bordered copy, work."""
BASE = 0.35 * GIB
"""Python, numpy, numba and the compiled kernels."""
SAMPLED_PIXELS = 192
"""Detector pixels per side, about, that are kept for the residual of each view."""


@dataclass(frozen=True, kw_only=True)
class MemoryPlan:
    """volume_bytes, images_bytes: needed in one piece; slabs: 1 where that fits; disk_bytes: read and written."""

    volume_bytes: int
    images_bytes: int
    slabs: int
    disk_bytes: int

    @property
    def in_one_piece(self) -> int:
        return int(BASE) + self.volume_bytes + self.images_bytes


def sampling_stride(matrices: ProjectionMatrices) -> int:
    """Every how many pixels a view is kept for its residual."""
    return max(1, math.ceil(max(matrices.n_u, matrices.n_v) / SAMPLED_PIXELS))


def available_bytes() -> int | None:
    """Memory that is free for this process, where the system reports it; None elsewhere."""
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, AttributeError):
        return None


def padded_bytes(grid: VoxelGrid, layers: int | None = None) -> int:
    """Bytes of the CPU engine's volume with its margins, of that many layers."""
    n_z, n_y, n_x = grid.shape
    return 4 * ((layers or n_z) + MARGIN) * (n_y + MARGIN) * (n_x + MARGIN)


def memory_limit(memory_gib: float | None) -> float | None:
    """Bytes to keep within: what was asked for, else what the system reports as free, else None."""
    if memory_gib is None:
        return available_bytes()
    if not memory_gib > 0:
        raise InputError(f"memory_gib is {memory_gib!r}; a positive number is needed")
    return memory_gib * GIB


def require_room_for_cgls(matrices: ProjectionMatrices, grid: VoxelGrid, *, memory_gib: float | None) -> None:
    """InputError where three volumes and three scans do not fit: CGLS holds both whole."""
    limit = memory_limit(memory_gib)
    needed = BASE + 3 * padded_bytes(grid) + 3 * 4 * len(matrices) * matrices.n_u * matrices.n_v
    if limit is not None and needed > limit:
        raise InputError(
            f"too little memory: CGLS needs {needed / GIB:.2f} GiB, {limit / GIB:.2f} GiB are there; SART streams its "
            "images and can work in slabs"
        )


def memory_plan(
    matrices: ProjectionMatrices,
    grid: VoxelGrid,
    *,
    subset_size: int,
    passes: float,
    memory_gib: float | None,
    most_voxels: int,
    may_cut: bool,
    support: bool = False,
) -> MemoryPlan:
    """How the volume goes into memory.

    `passes` is how often the whole scan is gone through.  Without `memory_gib` what the system reports as available is
    the limit.  Raises InputError, saying what would fit, where one piece does not and `may_cut` (a scratch folder) is
    missing, or where not even one layer does.
    """
    limit = memory_limit(memory_gib)
    n = len(matrices)
    samples = 4 * n * (matrices.n_u * matrices.n_v) // sampling_stride(matrices) ** 2
    images = IMAGE_COPIES * 4 * subset_size * matrices.n_u * matrices.n_v + samples
    per_voxel = 2.25 if support else 1.0
    volume = int(padded_bytes(grid) * per_voxel)
    plan = MemoryPlan(volume_bytes=volume, images_bytes=images, slabs=1, disk_bytes=0)
    fits = (limit is None or plan.in_one_piece <= limit) and padded_bytes(grid) // 4 <= most_voxels
    if fits:
        return plan
    room = (math.inf if limit is None else limit) - BASE - images
    room = min(room, 4.0 * most_voxels)
    layer = per_voxel * padded_bytes(grid, 1) / (1 + MARGIN)
    # A slab is read, worked on and written: the file's own pages and one piece of layers come on top of its state.
    layers = int((room * 0.8) // layer) - MARGIN
    if layers < 1:
        raise InputError(
            f"too little memory: one layer of {grid.shape[2]} x {grid.shape[1]} voxels and {subset_size} views need "
            f"{(BASE + images + (1 + MARGIN) * layer) / GIB:.2f} GiB, {(limit or 0) / GIB:.2f} GiB are there; "
            "use a smaller subset_size or a coarser grid"
        )
    if not may_cut:
        edge = int((max(room, 0.0) / (4 * per_voxel)) ** (1 / 3)) - MARGIN
        raise InputError(
            f"too little memory: {plan.in_one_piece / GIB:.2f} GiB are needed for {grid.shape[2]} x {grid.shape[1]} x "
            f"{grid.shape[0]} voxels, {(limit or 0) / GIB:.2f} GiB are there; {max(edge, 1)}^3 voxels would fit, or "
            "pass scratch=FOLDER to work in slabs on disk"
        )
    slabs = math.ceil(grid.shape[0] / layers)
    updates = math.ceil(n / subset_size) * passes
    return MemoryPlan(
        volume_bytes=volume, images_bytes=images, slabs=slabs, disk_bytes=int(3 * updates * 4 * grid.size)
    )
