"""`tomopose simulate` to files: TIFF and HDF5 hold the same, resume continues, and no executor changes a byte."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tomopose import open_images, read_poses, read_scanner, simulate
from tomopose.cli.simulated import frames, write_run
from tomopose.errors import FileError
from tomopose.io.images.stack import frames_kept
from tomopose.kept import StartsAnewWarning
from tomopose.simulation.run import run_key
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


@pytest.mark.slow
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


@pytest.mark.slow
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
        assert not (tmp_path / "halves/radiographs.h5").exists()
        assert frames_kept(tmp_path / "halves/radiographs.h5", run_key(run, form=form)) == 3
    told = []
    write_run(tmp_path / "halves", run, form=form, resume=True, progress=lambda done, n: told.append((done, n)))
    assert told[0][0] == 3
    assert told[-1] == (5, 5)
    assert digests(tmp_path / "halves") == digests(tmp_path / "whole")
    assert not list((tmp_path / "halves").glob("*partial*"))


def changed_runs(run):
    """One run for each thing that the images depend on, a little different from this one."""
    yield "scanner.d_SR", replace(run, scanner=replace(run.scanner, d_SR=run.scanner.d_SR + 1e-9))
    yield "seed", replace(run, seed=run.seed + 1)
    yield "t changed", replace(run, t=run.t + [0, 0, 1e-9])
    yield "detector.dark", replace(run, detector=replace(run.detector, dark=201.0))
    spectrum = replace(run.spectrum, weight=run.spectrum.weight * np.linspace(1, 1.01, run.spectrum.weight.size))
    yield "spectrum.weight", replace(run, spectrum=spectrum)
    yield "solids", replace(run, solids=run.solids[:1])
    yield "poses", replace(run, poses=run.poses.select([0, 1]), T_MH=run.T_MH[[0, 1]])
    yield "motion", replace(run, motion=replace(run.motion, alpha=1e-6))


@pytest.mark.slow
@pytest.mark.parametrize("form", ["tiff", "hdf5"])
def test_a_changed_scene_starts_anew_and_equals_a_fresh_run(run, tmp_path, form):
    for number, (words, other) in enumerate(changed_runs(run)):
        folder = tmp_path / str(number)
        write_run(folder, run, form=form)
        with pytest.warns(StartsAnewWarning, match=words):
            write_run(folder, other, form=form, resume=True)
        write_run(tmp_path / f"fresh-{number}", other, form=form)
        assert digests(folder) == digests(tmp_path / f"fresh-{number}")


@pytest.mark.slow
def test_an_interrupted_stack_of_another_scene_is_not_continued(run, tmp_path):
    class StopError(Exception):
        pass

    def stop(done, _):
        if done == 3:
            raise StopError

    with pytest.raises(StopError):
        write_run(tmp_path / "a", run, form="hdf5", progress=stop)
    other = replace(run, seed=7)
    with pytest.warns(StartsAnewWarning, match="seed was 6, now 7"):
        write_run(tmp_path / "a", other, form="hdf5", resume=True)
    write_run(tmp_path / "b", other, form="hdf5")
    assert digests(tmp_path / "a") == digests(tmp_path / "b")
    assert frames_kept(tmp_path / "a/radiographs.h5", run_key(other, form="hdf5")) == 0


@pytest.mark.slow
def test_another_package_version_starts_anew(run, tmp_path, monkeypatch):
    write_run(tmp_path, run)
    monkeypatch.setattr("tomopose.kept.package_version", lambda name: "0.0.1")
    with pytest.warns(StartsAnewWarning, match="version of tomopose was"):
        write_run(tmp_path, run, resume=True)


def test_the_other_format_leaves_nothing_of_the_first(run, tmp_path):
    write_run(tmp_path, run)
    with pytest.warns(StartsAnewWarning, match="form was 'tiff', now 'hdf5'"):
        write_run(tmp_path, run, form="hdf5", resume=True)
    assert not list((tmp_path / "radiographs").glob("*.tif"))


def test_radiographs_of_unknown_origin_are_not_removed(run, tmp_path):
    (tmp_path / "radiographs").mkdir()
    (tmp_path / "radiographs/pose_0000.tif").write_bytes(b"a measured image")
    with pytest.raises(FileError, match="force=True"):
        write_run(tmp_path, run, resume=True)
    assert (tmp_path / "radiographs/pose_0000.tif").read_bytes() == b"a measured image"
    with pytest.warns(StartsAnewWarning, match="no readable key"):
        write_run(tmp_path, run, resume=True, force=True)


KILLED = """
import os, sys
from pathlib import Path
sys.path[:0] = [sys.argv[2]]
from test_simulation_write import SCENE
from tomopose import simulate
from tomopose.cli.simulated import write_run
from tomopose.simulation.scene.scene import scene_from
write_run(Path(sys.argv[1]), simulate(scene_from(SCENE)), form="hdf5",
          progress=lambda done, n: os.kill(os.getpid(), 9) if done == 3 else None)
"""


@pytest.mark.slow
def test_every_finished_frame_outlives_a_kill(run, tmp_path):
    ended = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path / "a"), str(Path(__file__).parent)], check=False)
    assert ended.returncode == -9
    assert frames_kept(tmp_path / "a/radiographs.h5", run_key(run, form="hdf5")) == 3
    write_run(tmp_path / "a", run, form="hdf5", resume=True)
    write_run(tmp_path / "b", run, form="hdf5")
    assert digests(tmp_path / "a") == digests(tmp_path / "b")


FULL = """
import resource, sys
from pathlib import Path
sys.path[:0] = [sys.argv[2]]
from test_simulation_write import SCENE
from tomopose import simulate
from tomopose.cli.simulated import write_run
from tomopose.errors import FileError
from tomopose.simulation.scene.scene import scene_from
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[3]), resource.RLIM_INFINITY))
try:
    write_run(Path(sys.argv[1]), simulate(scene_from(SCENE)), form="hdf5")
except FileError as error:
    print(error)
    sys.exit(1)
"""


@pytest.mark.slow
@pytest.mark.parametrize("bytes_there", [20_000, 35_000])
def test_a_disk_without_room_for_the_stack_is_an_error(tmp_path, bytes_there):
    command = [sys.executable, "-c", FULL, str(tmp_path / "a"), str(Path(__file__).parent), str(bytes_there)]
    ended = subprocess.run(command, check=False, capture_output=True, text=True)
    assert ended.returncode == 1, ended.stderr
    assert "radiographs.h5 cannot be written: File too large" in ended.stdout
    assert not (tmp_path / "a/radiographs.h5").exists()


@pytest.mark.slow
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
