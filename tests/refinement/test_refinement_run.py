"""`refine` on a small scan whose line integrals are exact: better where views are off, never worse, exit codes."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile

import tomopose as tp
from tomopose.cli.main import run

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks" / "refine"))
import objects

PANEL = objects.Panel(n_u=47, n_v=43, p_u=2.8, p_v=2.7, u_0=24.3, v_0=20.2)
GRID = tp.VoxelGrid(shape=(32, 32, 32), spacing=0.63)


def scan(kind, obj="balls"):
    images, P, truth, _ = objects.scan(obj, "seven", kind, n=24, noise=0.004, panel=PANEL)
    ids = tuple(f"p{j}" for j in range(len(P)))
    return images, tp.ProjectionMatrices(P=P, n_u=47, n_v=43, p_u=2.8, p_v=2.7, pose_id=ids), truth


@pytest.mark.slow
def test_scattered_views_come_three_times_nearer_and_state_how_near():
    images, matrices, truth = scan("white")
    result = tp.refine(images, matrices, GRID, images_are="transmission", settings=tp.RefineSettings(threads=1))
    before, after = (objects.error_px(np.asarray(m), truth) for m in (matrices, result.matrices))
    assert result.verdict == "refined"
    assert after < before / 25  # 1.27 px; the noise alone would leave 0.02
    assert 0.5 < after / np.sqrt(2) / result.stated_px < 2
    assert 0.5 < result.halves_px / result.stated_px < 2
    assert result.matrices.points_sigma.shape == (24, 9)
    assert result.matrices.pose_id == matrices.pose_id
    assert result.edge_blur_after_mm < 0.9 * result.edge_blur_before_mm
    assert any("calibration alone" in sentence for sentence in result.unobservable)


@pytest.mark.slow
def test_a_right_geometry_is_returned_as_it_was_and_the_reason_is_said():
    images, matrices, _ = scan("none")
    result = tp.refine(images, matrices, GRID, images_are="transmission", settings=tp.RefineSettings(threads=1))
    assert result.verdict == "unchanged"
    assert result.trustworthy
    assert "Nothing is gained" in result.reasons[0]
    np.testing.assert_array_equal(np.asarray(result.matrices), np.asarray(matrices))


@pytest.mark.slow
def test_a_view_that_jumps_is_named_and_brought_back():
    images, matrices, truth = scan("jump")
    result = tp.refine(images, matrices, GRID, images_are="transmission", settings=tp.RefineSettings(threads=1))
    before, after = (objects.error_px(np.asarray(m), truth) for m in (matrices, result.matrices))
    assert result.verdict == "refined"
    assert result.outliers == (8,)
    assert after < before / 2


@pytest.mark.slow
def test_the_command_writes_matrices_json_and_report_and_refuses_an_object_beyond_the_grid(tmp_path, capsys):
    images, matrices, _ = scan("white", "rod")
    tp.write_matrices(tmp_path / "m.npz", matrices)
    tifffile.imwrite(tmp_path / "scan.tif", images[:, ::-1].astype(np.float32))
    words = (
        f"refine --matrices {tmp_path}/m.npz --images {tmp_path}/scan.tif --images-are transmission --voxel-mm 0.63 "
    )
    code = run([*(words + f"--size 32 --workers 1 --out {tmp_path}/out --json").split()])
    said = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert code == 3
    assert said["verdict"] == "undetermined"
    assert "-z, +z" in said["reasons"][0]
    kept = np.asarray(tp.read_matrices(tmp_path / "out" / "matrices.npz"))
    np.testing.assert_allclose(kept, np.asarray(matrices), rtol=1e-15, atol=1e-12)  # reading scales |P[2, :3]| to 1
    document = json.loads((tmp_path / "out" / "refined.json").read_text())
    assert document["schema"] == "tomopose/refined/1"
    assert len(document["views"]) == 24
    assert "not observable" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.slow
def test_an_object_that_leaves_the_view_is_named_by_the_edges_of_the_images():
    images, P, _, _ = objects.scan("cut", "seven", "white", n=16, noise=0.004, panel=PANEL)
    matrices = tp.ProjectionMatrices(P=P, n_u=47, n_v=43, p_u=2.8, p_v=2.7, pose_id=tuple(map(str, range(16))))
    wide = tp.VoxelGrid(shape=(32, 72, 72), spacing=0.63)
    result = tp.refine(images, matrices, wide, images_are="transmission", settings=tp.RefineSettings(threads=1))
    assert result.verdict == "undetermined"
    assert any("beyond the images (-u, +u" in reason for reason in result.reasons)
    np.testing.assert_array_equal(np.asarray(result.matrices), np.asarray(matrices))


class Killed(Exception):
    pass


@pytest.mark.slow
def test_a_killed_refinement_continues_after_its_last_level_to_the_same_numbers(tmp_path):
    images, matrices, _ = scan("white")
    asked = {"images_are": "transmission", "settings": tp.RefineSettings(threads=1, levels=(2, 1), steps=2, samples=4)}
    whole = tp.refine(images, matrices, GRID, **asked)

    def kill(done, _):
        if done == 3:
            raise Killed

    with pytest.raises(Killed):
        tp.refine(images, matrices, GRID, checkpoint=tmp_path / "kept", progress=kill, **asked)
    assert (tmp_path / "kept" / "reached.npz").exists()
    seen = []
    again = tp.refine(
        images, matrices, GRID, checkpoint=tmp_path / "kept", progress=lambda done, _: seen.append(done), **asked
    )
    np.testing.assert_array_equal(again.corrections, whole.corrections)
    np.testing.assert_array_equal(np.asarray(again.matrices), np.asarray(whole.matrices))
    assert not (tmp_path / "kept").exists()


@pytest.mark.slow
def test_the_workers_of_a_cluster_refine_to_the_same_bytes():
    distributed = pytest.importorskip("distributed")
    images, matrices, _ = scan("white")
    asked = {"levels": (2, 1), "steps": 2, "samples": 4}
    here = tp.refine(images, matrices, GRID, images_are="transmission", settings=tp.RefineSettings(threads=2, **asked))
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=False, dashboard_address=":0") as cluster,
        distributed.Client(cluster) as client,
    ):
        there = tp.refine(
            images, matrices, GRID, images_are="transmission", settings=tp.RefineSettings(client=client, **asked)
        )
    for name in ("corrections", "sigma", "residual_after"):
        np.testing.assert_array_equal(getattr(there, name), getattr(here, name))
    np.testing.assert_array_equal(np.asarray(there.matrices), np.asarray(here.matrices))
    np.testing.assert_array_equal(there.volume.values, here.volume.values)


def test_poses_of_another_number_are_refused():
    images, matrices, _ = scan("none")
    with pytest.raises(tp.TomoposeError, match="8 poses for 24 matrices"):
        tp.refine(images, matrices, GRID, poses=tp.circular_scan(8), images_are="transmission")


def test_too_few_views_are_refused():
    images, matrices, _ = scan("none")
    with pytest.raises(tp.TomoposeError, match="7 views are too few"):
        tp.refine(images[:7], matrices.select(slice(0, 7)), GRID, images_are="transmission")
