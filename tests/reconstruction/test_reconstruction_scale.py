"""Slabs on disk, a cluster, and a killed process give the numbers of one piece in memory."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from reconstruction_phantom import balls, images_of, scan

from tomopose.engines.storage import mapped
from tomopose.kept import StartsAnewWarning
from tomopose.reconstruction import FDK, SART, Execution, reconstruct
from tomopose.reconstruction.checkpoint import Checkpoint
from tomopose.reconstruction.field import Adding, Piece
from tomopose.reconstruction.memory import GIB, memory_plan, padded_bytes
from tomopose.volume import VoxelGrid

GRID = VoxelGrid.cube(n=40, spacing=0.15)
MATRICES = scan(GRID, n=36, n_u=61, n_v=57, field=1.3)
IMAGES = images_of(MATRICES, balls(GRID, m=4, radius=(0.07, 0.12)), fine=2)


def run(images=IMAGES, *, mask=None, progress=None, execution=None, **options):
    """FDK, then SART with those options."""
    return reconstruct(
        images,
        MATRICES,
        GRID,
        images_are="line-integrals",
        consistency="off",
        algorithm=SART(start=FDK(), **options),
        execution=execution,
        mask=mask,
        progress=progress,
    )


def rounding(a, b):
    return float(np.abs(a - b).max() / np.ptp(b))


@pytest.mark.slow
@pytest.mark.parametrize("settings", [{}, {"subset_size": 4, "nonnegative": True}])
def test_slabs_on_disk_are_the_whole(settings, tmp_path):
    _z, y, x = np.meshgrid(*(np.arange(40),) * 3, indexing="ij")
    mask = np.hypot(x - 19.5, y - 19.5) < 19.5 if settings else None
    whole = run(mask=mask, **settings)
    cut = run(mask=mask, **settings, execution=Execution(slabs=3, scratch=tmp_path))
    assert rounding(np.asarray(cut.values), whole.values) < 2e-5
    assert np.abs(cut.view_residual - whole.view_residual).max() < 1e-6
    assert np.array_equal(mapped(tmp_path / "volume.h5"), cut.values)


def test_memory_decides_on_slabs(tmp_path):
    big = VoxelGrid.cube(n=600, spacing=0.01)
    plan = memory_plan(MATRICES, big, subset_size=1, passes=2, memory_gib=0.7, most_voxels=2**31 - 1, may_cut=True)
    assert plan.in_one_piece > 0.7 * GIB
    thickest = -(-600 // plan.slabs)
    assert padded_bytes(big, thickest) + plan.images_bytes < 0.7 * GIB
    assert plan.disk_bytes > 2 * 36 * 4 * 600**3
    plan = memory_plan(
        MATRICES,
        VoxelGrid.cube(n=2000, spacing=0.001),
        subset_size=10,
        passes=1,
        memory_gib=64.0,
        most_voxels=2**31 - 1,
        may_cut=True,
    )
    assert plan.slabs > 1  # 32 GB fit, but not in one piece of 32 bit indices


BEFORE = 16 + 36
"""Images that are read before the first update: 16 for their rims, all for the checkpoint's key."""


class Killed(Exception):
    pass


class Dying:
    """Images that fail once a number of them has been read, as a killed process would."""

    def __init__(self, after):
        self.left = after

    def __len__(self):
        return len(IMAGES)

    def __getitem__(self, j):
        self.left -= 1
        if self.left < 0:
            raise Killed
        return IMAGES[j]


@pytest.mark.slow
@pytest.mark.parametrize("where", ["memory", "disk"])
@pytest.mark.parametrize("after", [BEFORE + 20, BEFORE + 60, BEFORE + 85])  # in the FDK start, in both sweeps of SART
def test_a_killed_run_continues_to_the_same_numbers(where, after, tmp_path):
    execution = Execution(checkpoint=tmp_path / "state", checkpoint_seconds=0.0)
    if where == "disk":
        execution = replace(execution, slabs=2, scratch=tmp_path / "slabs")
    settings = {"iterations": 2, "subset_size": 3, "execution": execution}
    expected = run(iterations=2, subset_size=3)
    with pytest.raises(Killed):
        run(Dying(after), **settings)
    assert (tmp_path / "state" / "state.json").exists()
    done = []
    found = run(progress=lambda k, n: done.append((k, n)), **settings)
    assert done[0][0] > 2  # it did not begin anew
    assert done[-1][0] == done[-1][1]
    if where == "memory":
        assert np.array_equal(found.values, expected.values)
    assert rounding(np.asarray(found.values), expected.values) < 2e-5
    assert not (tmp_path / "state" / "state.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize(("other", "named"), [({"relaxation": 0.5}, "algorithm"), ({"images": "brighter"}, "images")])
def test_another_reconstruction_starts_anew_and_says_so(other, named, tmp_path):
    """Never a mixture: other settings, or one pixel of one image, are another reconstruction."""
    execution = Execution(checkpoint=tmp_path, checkpoint_seconds=0.0)
    with pytest.raises(Killed):
        run(Dying(BEFORE + 45), execution=execution)
    if "images" in other:
        images = IMAGES.copy()
        images[20, 28, 30] += 1e-3
        other = {"images": images}
    expected = run(**other)
    with pytest.warns(StartsAnewWarning, match=named):
        found = run(execution=execution, **other)
    assert np.array_equal(found.values, expected.values)


@pytest.mark.slow
def test_killed_while_it_clears_its_checkpoint_it_ends_with_the_same_numbers(tmp_path, monkeypatch):
    execution = Execution(checkpoint=tmp_path, checkpoint_seconds=0.0)
    expected = run()

    def killed(self):
        (self._folder / "state.json").unlink()
        raise Killed

    with monkeypatch.context() as patched:
        patched.setattr(Checkpoint, "remove", lambda self: killed(self) if (tmp_path / "state.json").exists() else None)
        with pytest.raises(Killed):
            run(execution=execution)
    assert np.array_equal(run(execution=execution).values, expected.values)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_damaged_checkpoint_starts_anew_and_says_so(tmp_path):
    execution = Execution(checkpoint=tmp_path, checkpoint_seconds=0.0)
    with pytest.raises(Killed):
        run(Dying(BEFORE + 45), execution=execution)
    for saved in tmp_path.glob("saved-*/*"):
        saved.unlink()
    with pytest.warns(StartsAnewWarning, match="damaged"):
        found = run(execution=execution)
    assert np.array_equal(found.values, run().values)


def test_progress_counts_all_updates():
    seen = []
    run(progress=lambda done, total: seen.append((done, total)), subset_size=5, iterations=2)
    assert seen == [(k, 24) for k in range(1, 25)]  # 8 for the start by fives, 8 a sweep


def test_what_travels_to_a_cluster_survives_the_journey():
    piece = pickle.loads(pickle.dumps(Piece("cpu", MATRICES, GRID.slab(3, 20), None, {"threads": 1})))
    views = [0, 7]
    piece.back(IMAGES[views], views, Adding(weight="sum"))
    here = Piece("cpu", MATRICES, GRID.slab(3, 20), None, {"threads": 2})
    here.back(IMAGES[views], views, Adding(weight="sum"))
    assert np.array_equal(piece.values(), here.values())


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")
def test_a_cluster_is_the_whole():
    distributed = pytest.importorskip("distributed")
    whole = run(subset_size=6)
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=False, dashboard_address=":0", memory_limit=None
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        cut = run(subset_size=6, execution=Execution(client=client, engine_options={"threads": 1}))
    assert rounding(cut.values, whole.values) < 2e-5
