"""Values that one can hold: equality by content, hash, one screen of repr, rows by number and by name, tables."""

from __future__ import annotations

import inspect
import pickle
import sys
import warnings
from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import tomopose as tp
from tomopose import (
    BallObservations,
    PoseSequence,
    ProjectionMatrices,
    RigidTransform,
    Scanner,
    Volume,
    VoxelGrid,
    read_calibration,
)
from tomopose.errors import EngineMissingError, InputError
from tomopose.geometry.frames import Frame
from tomopose.values import equal

ROWS = ("p0", "p1", "p2", "p3")


def make_poses():
    rng = np.random.default_rng(5)
    return PoseSequence.from_table(rng.uniform(-9, 9, (4, 3)), rng.uniform(-6, 6, (4, 3)), pose_id=ROWS)


def make_observations():
    x = np.random.default_rng(6).uniform(0, 900, (4, 2))
    x[2] = np.nan
    return BallObservations.from_sigma(x, 0.01, pose_id=ROWS, snr=np.arange(4.0))


def make_matrices():
    rng = np.random.default_rng(7)
    P = rng.normal(size=(4, 3, 4)) + [[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 900.0]]
    return ProjectionMatrices(P=P, n_u=301, n_v=203, p_u=0.2, p_v=0.25, pose_id=ROWS, points_sigma=np.ones((4, 9)))


def make_scanner():
    return Scanner(
        d_SD=1200.0, d_SR=310.0, p_u=0.2, p_v=0.25, u_0=733.4, v_0=512.7, n_u=1501, n_v=1203, sigma={"u_0": 0.1}
    )  # fmt: skip


def make_transform():
    return RigidTransform.from_angles([0.1, -0.2, 3.1], [1.0, 2.0, 3.0], source=Frame.H, target=Frame.T)


def make_volume():
    return Volume(np.arange(24, dtype=np.float32).reshape(2, 3, 4), VoxelGrid((2, 3, 4), 0.1))


def make_calibration():
    """One with an identified hexapod: every block is there."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return read_calibration(Path(__file__).parents[1] / "io" / "files" / "calibration-1-hexapod.json")


MAKERS = [make_poses, make_observations, make_matrices, make_scanner, make_transform, make_volume, make_calibration]
SEQUENCES = [make_poses, make_observations, make_matrices]


@pytest.mark.parametrize("make", MAKERS)
def test_values_of_the_same_content_are_equal_and_share_a_hash(make):
    a, b = make(), pickle.loads(pickle.dumps(make()))
    assert a is not b
    assert a == b
    assert hash(a) == hash(b)
    assert {a: "found"}[b] == "found"
    assert a != "something else"


@pytest.mark.parametrize(
    ("make", "change"),
    [
        (make_poses, {"alpha": [0.0, 0.0, 0.0, 1e-12]}),
        (make_observations, {"snr": np.array([0.0, 1.0, 2.0, 4.0])}),
        (make_matrices, {"n_u": 302}),
        (make_scanner, {"sigma": {"u_0": 0.2}}),
        (make_transform, {"t": [1.0, 2.0, 3.0 + 1e-12]}),
        (make_volume, {"grid": VoxelGrid((2, 3, 4), 0.2)}),
    ],
)
def test_a_value_that_differs_in_one_field_is_another(make, change):
    assert replace(make(), **change) != make()
    assert hash(replace(make(), **change)) != hash(make())


@pytest.mark.parametrize("make", MAKERS)
def test_a_value_shows_itself_on_one_screen(make):
    text = repr(make())
    assert text.splitlines()[0].startswith(type(make()).__name__)
    assert len(text.splitlines()) <= 24
    assert max(map(len, text.splitlines())) <= 120
    # a calibration begins with its verdict
    title = getattr(make(), "verdict", "").capitalize() or type(make()).__name__
    assert title in make()._repr_html_()


def test_a_long_column_is_shown_by_its_shape_and_range():
    poses = PoseSequence.from_table(np.zeros((189, 3)), np.zeros((189, 3)), alpha=np.linspace(0, 1.5, 189))
    assert "PoseSequence of 189" in repr(poses)
    assert "alpha = array (189,) float64, 0 to 1.5" in repr(poses)


def test_equality_by_content_is_exact_and_knows_nan_and_signed_zero():
    assert equal([1.0, float("nan")], (1.0, float("nan")))
    assert equal(np.array([0.0, np.nan]), np.array([-0.0, np.nan]))
    assert not equal(np.array([1.0]), np.array([1.0 + 1e-15]))
    assert not equal(np.array([1.0]), np.array([[1.0]]))
    assert not equal({"a": 1}, {"a": 1, "b": 2})


@pytest.mark.parametrize("make", SEQUENCES)
def test_rows_are_taken_by_number_name_slice_and_mask(make):
    rows = make()
    assert len(rows) == 4
    assert rows[1].pose_id == rows["p1"].pose_id == ("p1",)
    assert rows[-1].pose_id == ("p3",)
    assert rows[1:3].pose_id == ("p1", "p2")
    assert rows[["p3", "p0"]].pose_id == ("p3", "p0")
    assert rows[np.array([True, False, False, True])].pose_id == ("p0", "p3")
    assert [row.pose_id[0] for row in rows] == list(ROWS)
    with pytest.raises(InputError, match="'p9'; the table holds 4 rows from 'p0' to 'p3'"):
        rows["p9"]
    with pytest.raises(IndexError, match="row 4 of 4"):
        rows[4]


def test_arrays_of_values_are_their_numbers():
    assert_array_equal(np.asarray(make_matrices()), make_matrices().P)
    assert_array_equal(np.asarray(make_observations()), make_observations().x_D)
    assert np.asarray(make_poses()).shape == (4, 4, 4)
    assert_array_equal(np.asarray(make_transform()), make_transform().matrix)
    assert_array_equal(np.asarray(make_volume()), make_volume().values)


@pytest.mark.parametrize("make", SEQUENCES)
def test_rows_become_a_data_frame(make):
    import pandas

    frame = make().to_dataframe()
    assert isinstance(frame, pandas.DataFrame)
    assert list(frame.index) == list(ROWS)
    assert list(frame.columns) == list(make().columns())


def test_without_pandas_the_install_line_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(EngineMissingError) as caught:
        make_poses().to_dataframe()
    assert caught.value.install_line == "pip install pandas"


HELD_BY_IDENTITY = {"TriangleMesh"}
"""The key of its own search tree's cache: a hash of all its vertices would cost more than the tree."""


def test_every_public_value_with_arrays_is_compared_by_content():
    """The comparison that a dataclass writes for itself raises ValueError for arrays, and its hash TypeError."""
    wrong = []
    for name in set(tp.__all__) - HELD_BY_IDENTITY:
        kind = getattr(tp, name)
        if not (inspect.isclass(kind) and is_dataclass(kind)) or issubclass(kind, Exception):
            continue
        holds_arrays = any(word in str(f.type) for f in fields(kind) for word in ("Array", "ndarray"))
        if holds_arrays and kind.__eq__ is not tp.Volume.__eq__:
            wrong.append(name)
    assert sorted(wrong) == []
