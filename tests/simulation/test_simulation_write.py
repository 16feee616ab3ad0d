"""`tomopose simulate` to files: TIFF and HDF5 hold the same, resume goes on, and no executor changes a byte."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np
import pytest

from tomopose import open_images, read_poses, read_scanner, simulate
from tomopose.cli.simulated import frames, write_run
from tomopose.errors import FileError, InputError
from tomopose.io.images.stack import frames_kept, partial
from tomopose.simulation.scene.scene import scene_from

SCENE = {
    "schema": "tomopose/scene/1",
    "seed": 6,
    "scanner": {
        "d_SD_mm": 800.0,
        "d_SR_mm": 200.0,
        "p_u_mm": 0.8,
        "p_v_mm": 0.9,
        "u_0_px": 30.0,
        "v_0_px": 31.0,
        "n_u_px": 61,
        "n_v_px": 63,
    },
    "source": {"voltage_kV": 120.0},
    "detector": {
        "noise_sigma_px": 0.6,
        "readout_noise": 5.0,
        "dark": 200.0,
        "lag": [0.02],
        "scatter": {"constant": 0.01, "amount": 0.02, "sigma_px": 12.0},
    },
    "objects": [{"kind": "ball", "diameter_mm": 4.0}],
    "poses": {"scan": {"n": 5}},
}


@pytest.fixture
def run():
    return simulate(scene_from(SCENE))


def digests(folder):
    files = [p for p in sorted(folder.rglob("*")) if p.suffix in (".csv", ".h5", ".tif")]
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def test_tiff_and_hdf5_hold_the_run_and_are_read_as_radiographs(run, tmp_path):
    for form, place in (("tiff", "radiographs"), ("hdf5", "radiographs.h5")):
        write_run(tmp_path / form, run, form=form)
        folder = tmp_path / form
        images = open_images(folder / place, read_scanner(folder / "scanner.json"))
        assert images.names == tuple(read_poses(folder / "poses.csv").image)
        assert len(images) == 5
        for k in (0, 4):
            assert (images[k] == run.image(k)).all()
        assert sorted(p.name for p in folder.iterdir()) == sorted([place, "poses.csv", "scanner.json", "truth.json"])
        with pytest.raises(FileError):
            write_run(folder, run, form=form)


@pytest.mark.parametrize("form", ["tiff", "hdf5"])
def test_workers_and_an_interruption_change_no_byte(run, tmp_path, form):
    write_run(tmp_path / "whole", run, form=form)
    write_run(tmp_path / "threads", run, form=form, workers=3)
    assert digests(tmp_path / "threads") == digests(tmp_path / "whole")

    class StopError(Exception):
        pass

    def stop(done, _):
        if done == 3:
            raise StopError

    with pytest.raises(StopError):
        write_run(tmp_path / "halves", run, form=form, progress=stop)
    if form == "hdf5":
        # The last frame of an interrupted stack is not trusted.
        assert not (tmp_path / "halves/radiographs.h5").exists()
        assert frames_kept(tmp_path / "halves/radiographs.h5") == 2
    told = []
    write_run(tmp_path / "halves", run, form=form, resume=True, progress=lambda done, n: told.append((done, n)))
    assert told[0][0] in (2, 3)
    assert told[-1] == (5, 5)
    assert digests(tmp_path / "halves") == digests(tmp_path / "whole")
    assert not partial(tmp_path / "halves/radiographs.h5").exists()


def test_a_whole_stack_of_another_scene_is_no_beginning(run, tmp_path):
    write_run(tmp_path, run, form="hdf5")
    write_run(tmp_path, run, form="hdf5", resume=True)
    other = replace(run, poses=run.poses.select([0, 1]), T_MH=run.T_MH[[0, 1]])
    with pytest.raises(InputError, match="whole with 5 frames"):
        write_run(tmp_path, other, form="hdf5", resume=True)


def test_a_dask_cluster_makes_the_same_bytes(run, tmp_path):
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=False, dashboard_address=":0") as cluster,
        distributed.Client(cluster) as client,
    ):
        write_run(tmp_path / "cluster", run, client=client)
        there = dict(frames(run, [3, 1], client=client))
    write_run(tmp_path / "here", run)
    assert digests(tmp_path / "cluster") == digests(tmp_path / "here")
    assert list(there) == [3, 1]
    np.testing.assert_array_equal(there[3], run.image(3))
