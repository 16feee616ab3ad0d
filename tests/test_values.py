"""The value types that everything else is made of: what they hold, refuse and select."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tomopose import BallObservations, PoseSequence
from tomopose.errors import FileError, InputError, SchemaVersionError, ShapeError
from tomopose.files import atomic_file, atomic_folder, plain, read_json, require_absent, write_json, write_text
from tomopose.provenance import provenance
from tomopose.units import value_with_uncertainty


@pytest.mark.parametrize(
    ("value", "u", "shown"),
    [
        (12.34, 0.4, "12.3(4) um"),
        (12.3456, 0.0123, "12.346(12) um"),
        (-0.00012345, 0.0000031, "-0.000123(3) um"),
        (1234.0, 30.0, "1230(30) um"),
        (5.0, 0.0, "5 um (uncertainty not determinable)"),
        (5.0, math.inf, "5 um (uncertainty not determinable)"),
        (5.0, math.nan, "5 um (uncertainty not determinable)"),
    ],
)
def test_values_are_written_with_their_uncertainty(value, u, shown):
    assert value_with_uncertainty(value, u, "um") == shown


@pytest.fixture
def observations(rng):
    x_D = rng.uniform(0, 1000, (5, 2))
    x_D[3] = np.nan
    return BallObservations.from_sigma(x_D, 0.01, snr=np.arange(5.0), image=[f"i{k}.tif" for k in range(5)])


def test_rows_without_a_centre_do_not_count_as_seen(observations):
    assert observations.seen.tolist() == [True, True, True, False, True]
    assert observations.status[3] == "not seen"
    assert observations.used.pose_id == ("0", "1", "2", "4")
    assert_allclose(observations.used.snr, [0, 1, 2, 4])


@pytest.mark.parametrize("index", [slice(1, 3), [1, 2], np.array([False, True, True, False, False])])
def test_rows_are_selected_by_slice_list_or_mask(observations, index):
    part = observations.select(index)
    assert part.pose_id == ("1", "2")
    assert part.image == ("i1.tif", "i2.tif")
    poses = PoseSequence.from_table(np.zeros((5, 3)), np.zeros((5, 3)), alpha=np.arange(5.0))
    assert_allclose(poses.select(index).alpha, [1, 2])


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"pose_id": list("aabcd")}, InputError, "'a' is observed more than once"),
        ({"seen": [True] * 5}, InputError, "counts as seen but is not a finite number"),
        ({"pose_id": list("ab")}, ShapeError, "5 observations but 2 pose ids"),
        ({"sigma": [[0.01, 0.0]] * 5}, InputError, "not positive definite"),
        ({"snr": np.zeros(3)}, ShapeError, "3 values of snr"),
    ],
)
def test_observations_that_contradict_themselves(rng, change, error, message):
    x_D = rng.uniform(0, 1000, (5, 2))
    if "seen" in change:
        x_D[2, 0] = np.nan
    with pytest.raises(error, match=message):
        BallObservations.from_sigma(x_D, change.pop("sigma", 0.01), **change)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"pose_id": ["a", "a", "b"]}, InputError, "appears more than once"),
        ({"alpha": [0.0, np.nan, 0.0]}, InputError, "alpha of pose '1' is not finite"),
        ({"alpha": [0.0]}, ShapeError, "one value for each of 3 poses"),
        ({"image": ["a.tif"]}, ShapeError, "1 entries in image"),
        ({"q": np.zeros((2, 6))}, ShapeError, "joint values"),
    ],
)
def test_pose_tables_that_contradict_themselves(change, error, message):
    with pytest.raises(error, match=message):
        PoseSequence.from_table(np.zeros((3, 3)), np.zeros((3, 3)), **change)


def test_unknown_pose_ids_are_named():
    poses = PoseSequence.from_table(np.zeros((3, 3)), np.zeros((3, 3)), pose_id=["a", "b", "c"])
    assert poses.index_of(["c", "a"]).tolist() == [2, 0]
    with pytest.raises(InputError, match="'z'"):
        poses.index_of(["a", "z"])
    with pytest.raises(InputError, match="holds no set poses"):
        poses.set_poses()


# -- files -------------------------------------------------------------------------------------------------------------


def test_json_round_trip_with_schema_and_provenance(tmp_path):
    path = tmp_path / "a.json"
    made = provenance(inputs=[__file__], arguments={"n": 1}, seed=3)
    write_json(path, "thing", {"x": np.array([0.1, np.inf]), "n": np.int64(3), "provenance": made.to_json()})
    content = read_json(path, "thing")
    assert content["schema"] == "tomopose/thing/1"
    assert content["x"] == [0.1, None]
    assert len(content["provenance"]["inputs"]["test_values.py"]) == 64
    assert type(made).from_json(content["provenance"]) == made


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        ('{"schema": "tomopose/thing/2"}', SchemaVersionError, "version 2 is newer than 1"),
        ('{"schema": "tomopose/other/1"}', SchemaVersionError, "tomopose/thing/1"),
        ("{}", SchemaVersionError, "schema is None"),
        ("[1]", FileError, "no JSON object"),
        ("{", FileError, "no JSON"),
    ],
)
def test_json_of_another_kind_is_refused(tmp_path, text, error, message):
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(error, match=message):
        read_json(path, "thing")


def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path):
    path = tmp_path / "a.txt"
    write_text(path, "old")

    def fail():
        with atomic_file(path) as temporary:
            temporary.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_is_written_whole_or_not_at_all(tmp_path):
    out = tmp_path / "out"
    with atomic_folder(out) as folder:
        (folder / "a.txt").write_text("1")
        (folder / "deep").mkdir()
        (folder / "deep" / "b.txt").write_text("2")
    assert (out / "deep" / "b.txt").read_text() == "2"

    def again():
        with atomic_folder(out) as folder:
            (folder / "c.txt").write_text("3")
            (folder / "a.txt").write_text("new")

    with pytest.raises(FileError, match="force=True"):
        again()
    assert (out / "a.txt").read_text() == "1"
    assert not (out / "c.txt").exists()
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_what_exists_is_not_overwritten(tmp_path):
    path = tmp_path / "a"
    path.write_text("")
    with pytest.raises(FileError, match="exists already"):
        require_absent(path)
    assert require_absent(path, force=True) == path


def test_plain_values():
    assert plain({"a": (np.float32(1.5), np.bool_(True)), 3: math.nan}) == {"a": [1.5, True], "3": None}
