"""A run that is being taken: images as they arrive, coverage, what is known, and the next best pose."""

from __future__ import annotations

import math
import shutil
import threading

import numpy as np
import pytest

import tomopose as tp
from tomopose.planning.design import nominal_mount
from tomopose.planning.limits import PlanLimits
from tomopose.planning.next_pose import next_pose
from tomopose.review.watch import Setup, Watcher, coverage, expected_names


@pytest.fixture
def watcher(project, tmp_path):
    folder = tmp_path / "arriving"
    folder.mkdir()
    limits = PlanLimits(table_angles=(0.0, math.radians(90.0)), ball_radius=4.0)
    setup = Setup(
        scanner=tp.read_scanner(project.folder / "scanner.json"), poses=tp.read_poses(project.folder / "poses.csv"),
        folder=folder, ball_diameter=8.0, limits=limits,
    )  # fmt: skip
    return Watcher(setup=setup), project.folder / "radiographs" / "p000.tif"


def test_an_image_counts_when_its_size_has_settled(watcher):
    watched, picture = watcher
    watched.look()
    assert watched.state["words"] == "No ball was measured yet."
    target = watched.setup.folder / "p000.tif"
    whole = picture.read_bytes()
    target.write_bytes(whole[:5000])
    assert not watched.look()
    target.write_bytes(whole)
    assert not watched.look()
    (watched.setup.folder / "notes.txt").write_text("x")
    assert watched.look()
    (arrived,) = watched.state["arrived"]
    assert (arrived["pose"], arrived["status"]) == ("p000", "ok")
    assert len(watched.state["missing"]) == 199
    assert watched.state["command"].splitlines()[3].startswith("MOV X ")


def test_a_damaged_image_is_named_and_does_not_end_the_run(watcher):
    watched, picture = watcher
    (watched.setup.folder / "p001.tif").write_bytes(b"II*\0nonsense")
    shutil.copy(picture, watched.setup.folder / "p000.tif")
    watched.look()
    watched.look()
    states = {a["pose"]: a["x"] for a in watched.state["arrived"]}
    assert states["p001"] is None
    assert states["p000"] is not None


def test_an_image_that_is_written_anew_is_measured_again(watcher):
    watched, picture = watcher
    target = watched.setup.folder / "p000.tif"
    target.write_bytes(b"II*\0nonsense")
    watched.look()
    assert watched.look()
    assert [a["x"] for a in watched.state["arrived"]] == [None]
    assert not watched.look()
    shutil.copy(picture, target)
    watched.look()
    assert watched.look()
    (arrived,) = watched.state["arrived"]
    assert arrived["status"] == "ok"
    assert not watched.look()


def test_a_folder_that_is_gone_for_a_moment_changes_nothing(watcher):
    watched, picture = watcher
    shutil.copy(picture, watched.setup.folder / "p000.tif")
    watched.look()
    watched.look()
    aside = watched.setup.folder.with_name("aside")
    watched.setup.folder.rename(aside)
    assert not watched.look()
    aside.rename(watched.setup.folder)
    assert not watched.look()
    assert len(watched.state["arrived"]) == 1


def test_before_the_first_look_the_state_is_that_of_an_empty_run(watcher):
    watched, _ = watcher
    assert (watched.state["arrived"], watched.state["expected"]) == ([], 200)


def test_a_watch_that_fails_says_so_on_the_page(watcher, monkeypatch):
    watched, _ = watcher

    def broken():
        raise RuntimeError("no more memory")

    monkeypatch.setattr(watched, "look", broken)
    with pytest.raises(RuntimeError):
        watched.run(threading.Event(), seconds=0.0)
    assert watched.state["failed"]
    assert "not being watched any more (RuntimeError: no more memory)" in watched.state["words"]


def test_names_come_from_the_table_or_from_the_pose_ids(watcher):
    watched, _ = watcher
    assert expected_names(watched.setup.poses)["p003.tif"] == "p003"
    named = tp.PoseSequence.from_table(np.zeros((2, 3)), np.zeros((2, 3)), pose_id=["a", "b"], image=["1.tif", "2.tif"])
    assert expected_names(named) == {"1.tif": "a", "2.tif": "b"}


def test_coverage_counts_parts_of_the_panel_and_spans_of_the_axes(watcher):
    watched, _ = watcher
    scanner = watched.setup.scanner
    poses = tp.PoseSequence.from_table([[0, 0, 0], [4, -3, 0]], [[0, 0, 0], [0, 2, 0]], alpha=[0.0, math.pi / 2])
    found = coverage(scanner, poses, np.array([[1.0, 1.0], [scanner.n_u - 1.0, scanner.n_v - 1.0]]))
    assert found["panel"] == 2 / 16
    assert found["spans"]["x / mm"] == 4.0
    assert found["spans"]["about y / °"] == pytest.approx(2.0)
    assert found["table_angles"] == [0.0, 90.0]


def test_the_next_pose_turns_the_table_where_one_angle_hides_a_direction(watcher):
    """With the table still, d_SR and the mount along the beam are one direction: a second angle must come next."""
    watched, _ = watcher
    scanner, limits = watched.setup.scanner, watched.setup.limits
    still = tp.pose_grid(3)
    best = next_pose(scanner, still, T_HT=nominal_mount(), t=[3.0, -2.0, 21.0], limits=limits)
    assert best.pose.alpha[0] == pytest.approx(math.radians(90.0))
    assert best.after < best.before
    assert math.isfinite(best.before)


def test_what_few_poses_cannot_determine_is_named(watcher):
    watched, _ = watcher
    one = tp.PoseSequence.from_table(np.zeros((1, 3)), np.zeros((1, 3)))
    best = next_pose(watched.setup.scanner, one, T_HT=nominal_mount(), t=[3.0, -2.0, 21.0], limits=watched.setup.limits)
    assert math.isinf(best.before)
    assert {"t_HT_x", "t_x"} & set(best.undetermined)
