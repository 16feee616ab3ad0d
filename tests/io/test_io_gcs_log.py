"""Logs of a hexapod controller's replies, and recordings."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tomopose.errors import ConventionError, InputError, UnitError
from tomopose.geometry.rotations import rotation_from_angles
from tomopose.io import read_gcs_log

LOG = """\
# run of the morning
*IDN?
(c)2019 Physik Instrumente (PI) GmbH & Co. KG, C-887.53, 0, 3.0.0.1
SPI?
R=0.0000000e+00
S=0.0000000e+00
T=8.2500000e+01
KEN?
ZERO=1
POS?
X=-1.0000210e+01\x20
Y=2.0000000e-04
Z=1.0000000e+01
U=0.0000000e+00
V=5.0001000e+00
W=0.0000000e+00
MOV?
X=-10 Y=0 Z=10 U=0 V=5 W=0
POS?
X=10 Y=0 Z=10.0001 U=5.0002 V=0 W=-1 A=0 B=0
MOV?
X=10 Y=0 Z=10 U=5 V=0 W=-1
KEN?
ZERO=1
"""


@pytest.fixture
def log(tmp_path):
    def write(text: str):
        path = tmp_path / "hexapod.log"
        path.write_text(text)
        return path

    return write


def test_replies_become_encoder_and_set_poses_with_their_pivot(log):
    poses = read_gcs_log(log(LOG))
    assert poses.pose_id == ("0", "1")
    assert poses.source == "encoder"
    assert poses.convention == "pi-hexapod"
    assert poses.pivot.tolist() == [0, 0, 82.5]
    np.testing.assert_array_equal(poses.T_MH.t, [[-10.00021, 0.0002, 10], [10, 0, 10.0001]])
    np.testing.assert_array_equal(poses.T_MH_set.t, [[-10, 0, 10], [10, 0, 10]])
    np.testing.assert_allclose(poses.T_MH.R[1], rotation_from_angles(np.radians([5.0002, 0, -1])), atol=1e-15)


def test_replies_without_queries_are_positions(log):
    one = "X=1\nY=2\nZ=3\nU=0\nV=5\nW=0\n"
    poses = read_gcs_log(log(one + one.replace("=1", "=4")))
    assert poses.T_MH.t[:, 0].tolist() == [1, 4]
    assert poses.T_MH_set is None


def test_commanded_poses_alone_are_set_poses(log):
    poses = read_gcs_log(log("MOV?\nX=1 Y=2 Z=3 U=0 V=5 W=0\n"))
    assert poses.source == "set"


def test_the_commanded_pose_may_come_first(log):
    text = "MOV?\nX=1 Y=2 Z=3 U=0 V=5 W=0\nPOS?\nX=1.001 Y=2 Z=3 U=0 V=5 W=0\n"
    poses = read_gcs_log(log(text + text))
    assert poses.T_MH.t[:, 0].tolist() == [1.001, 1.001]
    assert poses.T_MH_set.t[:, 0].tolist() == [1, 1]


def test_a_recording_is_a_table(log):
    poses = read_gcs_log(log("X\tY\tZ\tU\tV\tW\timage\n1\t2\t3\t0\t5\t0\ta.tif\n4\t5\t6\t0\t-5\t0\tb.tif\n"))
    assert poses.image == ("a.tif", "b.tif")
    assert poses.T_MH.t.tolist() == [[1, 2, 3], [4, 5, 6]]
    with_set = "X,Y,Z,U,V,W,X_set,Y_set,Z_set,U_set,V_set,W_set\n1,2,3,0,5,0,1,2,3,0,5,0\n"
    assert read_gcs_log(log(with_set)).T_MH_set is not None


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(
        st.tuples(*[st.floats(-50, 50).map(lambda x: x + 100)] * 3, *[st.floats(1, 30)] * 3), min_size=1, max_size=5
    )
)
def test_every_digit_of_a_reply_counts(tmp_path, rows):
    axes = "XYZUVW"
    path = tmp_path / "hexapod.log"
    path.write_text("".join("POS?\n" + "".join(f"{a}={x!r}\n" for a, x in zip(axes, r, strict=True)) for r in rows))
    poses = read_gcs_log(path)
    np.testing.assert_array_equal(poses.T_MH.t, np.array(rows)[:, :3])
    np.testing.assert_allclose(poses.T_MH.R, rotation_from_angles(np.radians(np.array(rows)[:, 3:])), atol=1e-14)


def test_a_pivot_that_changes_is_refused(log):
    changed = LOG + "SPI?\nR=0 S=0 T=90\nPOS?\nX=1 Y=2 Z=3 U=0 V=5 W=0\nMOV?\nX=1 Y=2 Z=3 U=0 V=5 W=0\n"
    with pytest.raises(InputError, match=r"line 25: the reply to SPI\? differs from that in line 4; pivot"):
        read_gcs_log(log(changed))


def test_a_coordinate_system_that_changes_is_refused(log):
    with pytest.raises(InputError, match=r"reply to KEN\? differs"):
        read_gcs_log(log(LOG + "KEN?\nTOOL2=1\n"))


@pytest.mark.parametrize("command", ["SPI R 0 S 0 T 5", "KEN TOOL2", "FRF"])
def test_commands_that_move_the_system_between_poses_are_refused(log, command):
    name = command.split()[0]
    with pytest.raises(InputError, match=f"line 19: {name} changes pivot, coordinate system or reference"):
        read_gcs_log(log(LOG.replace("V=5 W=0\nPOS?", f"V=5 W=0\n{command}\nPOS?")))


def test_such_commands_before_the_run_and_moves_within_are_fine(log):
    text = "FRF\nSPI R 0\n" + LOG.replace("W=0\nPOS?", "W=0\nMOV X 10 U 5\nPOS?")
    assert len(read_gcs_log(log(text))) == 2


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("V=5.0001000e+00\n", "", r"line 10: the reply to POS\? lacks V"),
        ("V=5.0001000e+00", "V=nan", "line 15: V=nan is no finite number"),
        ("V=5.0001000e+00", "Q=5", "line 15: axis 'Q' is unknown"),
        ("V=5.0001000e+00", "0 0 error", r"line 15: '0 0 error' is no reply to POS\?"),
        ("MOV?\nX=10 Y=0 Z=10 U=5 V=0 W=-1\n", "", r"pose 1 \(line 19\) has POS\?, pose 0 POS\? and MOV\?"),
        ("T=8.2500000e+01\n", "", r"reply to SPI\? has R, S; R, S, T are needed"),
        ("T=8.2500000e+01", "T=9999", "no"),
    ],
)
def test_what_is_missing_or_wrong_is_named_by_line(log, old, new, message):
    if message == "no":  # a pivot of 9999 mm is a number like any other
        assert read_gcs_log(log(LOG.replace(old, new))).pivot[2] == 9999
        return
    with pytest.raises(InputError, match=message):
        read_gcs_log(log(LOG.replace(old, new)))


def test_an_empty_log_is_refused(log):
    with pytest.raises(InputError, match=r"no reply to POS\? or MOV\?"):
        read_gcs_log(log("# nothing\n"))


def test_unit_and_column_rules_are_those_of_poses(log):
    with pytest.raises(UnitError, match="look like radians"):
        read_gcs_log(log("POS?\nX=1 Y=2 Z=3 U=0 V=0.0873 W=0\n"))
    with pytest.raises(InputError, match="column 'speed' is unknown"):
        read_gcs_log(log("X,Y,Z,U,V,W,speed\n1,2,3,0,5,0,1\n"))
    with pytest.raises(ConventionError, match="belongs to convention"):
        read_gcs_log(log("# convention: kuka\nX,Y,Z,U,V,W\n1,2,3,0,5,0\n"))
