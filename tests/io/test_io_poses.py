"""poses.csv: round trips, dialects, conventions, and every bad table with its message."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tomopose import PoseSequence, RigidTransform
from tomopose.errors import ConventionError, FileError, InputError, UnitError
from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import CONVENTIONS, exp_rotation, rotation_angle_between, rotation_from_angles
from tomopose.io import InputWarning, read_poses, write_poses

HEAD = "pose_id,x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg"
GOOD = f"{HEAD}\n0,-10,0,10,0,5,0\n1,10,0.5,-10,0,-5,1\n"


@pytest.fixture
def table(tmp_path):
    """Write a table and return its path."""

    def write(text: str | bytes, name: str = "poses.csv"):
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


def random_poses(rng: np.random.Generator, n: int = 5, **columns) -> PoseSequence:
    T = RigidTransform(
        R=exp_rotation(rng.normal(size=(n, 3))), t=rng.normal(size=(n, 3)) * 20, source=Frame.M, target=Frame.H
    )
    return PoseSequence(T_MH=T, pose_id=tuple(f"p{k}" for k in range(n)), **columns)


def assert_same(a: PoseSequence, b: PoseSequence) -> None:
    assert a.pose_id == b.pose_id
    np.testing.assert_array_equal(a.T_MH.t, b.T_MH.t)
    assert rotation_angle_between(a.T_MH.R, b.T_MH.R).max() < 1e-12
    np.testing.assert_allclose(a.alpha, b.alpha, rtol=1e-15)
    np.testing.assert_array_equal(a.ball_id, b.ball_id)
    assert (a.image, a.time_utc, a.convention, a.source) == (b.image, b.time_utc, b.convention, b.source)
    assert (a.T_MH_set is None) == (b.T_MH_set is None)
    assert (a.pivot is None) == (b.pivot is None)


# -- what is read ------------------------------------------------------------------------------------------------------


def test_the_plain_table_is_read(table):
    poses = read_poses(table(GOOD))
    assert poses.pose_id == ("0", "1")
    assert poses.source == "encoder"
    assert poses.convention == "pi-hexapod"
    np.testing.assert_array_equal(poses.T_MH.t[1], [10, 0.5, -10])
    np.testing.assert_allclose(poses.T_MH.R[1], rotation_from_angles(np.radians([0, -5, 1])), atol=1e-15)
    assert not poses.alpha.any()


def test_the_third_party_table_is_read(shared_data):
    poses = read_poses(shared_data / "ball-radiographs-gvxr" / "poses.csv")
    assert len(poses) == 56
    assert poses.image[55] == "pose_0055.tif"


@pytest.mark.parametrize("name", list(CONVENTIONS))
def test_every_convention_comes_back(tmp_path, rng, name):
    poses = random_poses(rng, convention=name)
    write_poses(tmp_path / "poses.csv", poses)
    assert_same(read_poses(tmp_path / "poses.csv"), poses)


def test_one_pose_in_another_convention_is_the_same_rotation(tmp_path, rng):
    poses = random_poses(rng)
    write_poses(tmp_path / "poses.csv", poses, convention="kuka")
    again = read_poses(tmp_path / "poses.csv")
    assert again.convention == "kuka"
    assert rotation_angle_between(poses.T_MH.R, again.T_MH.R).max() < 1e-12


def test_all_columns_come_back(tmp_path, rng):
    n = 5
    near = random_poses(rng)
    shift = RigidTransform(R=near.T_MH.R, t=near.T_MH.t + 0.001, source=Frame.M, target=Frame.H)
    poses = PoseSequence(
        T_MH=near.T_MH,
        pose_id=near.pose_id,
        alpha=np.linspace(0, 3, n),
        ball_id=[0, 1, 0, 2, 0],
        image=tuple(f"a, b{k}.tif" for k in range(n)),
        time_utc=tuple(f"2026-01-0{k + 1}T00:00:00Z" for k in range(n)),
        T_MH_set=shift,
        pivot=[0.1, -0.2, 30.0],
        q=np.outer(np.arange(n), np.ones(6)) / 7,
    )
    write_poses(tmp_path / "poses.csv", poses, comments=[("operator", "none")])
    again = read_poses(tmp_path / "poses.csv")
    assert_same(again, poses)
    np.testing.assert_array_equal(again.T_MH_set.t, shift.t)
    np.testing.assert_array_equal(again.pivot, poses.pivot)
    np.testing.assert_allclose(again.q, poses.q, atol=1e-15)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(
        st.tuples(*[st.floats(-300, 300)] * 3, *[st.floats(-1.5, 1.5)] * 3, st.floats(-400, 400)),
        min_size=1,
        max_size=6,
    )
)
def test_whatever_is_written_is_read(tmp_path, rows):
    values = np.array(rows)
    T = RigidTransform.from_angles(values[:, 3:6], values[:, :3], source=Frame.M, target=Frame.H)
    poses = PoseSequence(T_MH=T, pose_id=tuple(map(str, range(len(rows)))), alpha=values[:, 6])
    write_poses(tmp_path / "poses.csv", poses, force=True)
    assert_same(read_poses(tmp_path / "poses.csv"), poses)


def test_bom_crlf_and_tabs_are_accepted(table):
    text = "\ufeff# convention: pi-hexapod\r\n" + GOOD.replace(",", "\t").replace("\n", "\r\n")
    assert_same(read_poses(table(text)), read_poses(table(GOOD, "plain.csv")))


def test_semicolons_with_decimal_commas_are_read_with_a_warning(table):
    text = GOOD.replace(",", ";").replace("0.5", "0,5")
    with pytest.warns(InputWarning, match="decimal commas"):
        poses = read_poses(table(text))
    assert_same(poses, read_poses(table(GOOD, "plain.csv")))


def test_semicolons_with_decimal_points_are_read(table):
    assert_same(read_poses(table(GOOD.replace(",", ";"))), read_poses(table(GOOD, "plain.csv")))


def test_comment_lines_padded_by_a_spreadsheet_are_read(table):
    assert read_poses(table("# convention: symetrie-hexapod,,,,,,\n" + GOOD)).convention == "symetrie-hexapod"


def test_set_columns_alone_are_set_poses(table):
    head = "pose_id,x_set_mm,y_set_mm,z_set_mm,rx_set_deg,ry_set_deg,rz_set_deg"
    poses = read_poses(table(GOOD.replace(HEAD, head)))
    assert poses.source == "set"
    assert poses.T_MH_set is None


def test_source_set_is_read(table):
    assert read_poses(table("# source: set\n" + GOOD)).source == "set"


def test_the_pivot_is_read_with_commas_or_blanks(table):
    for text in ("1, 2.5, -3", "1 2.5 -3", "[1; 2.5; -3]"):
        assert read_poses(table(f"# pivot_mm: {text}\n" + GOOD)).pivot.tolist() == [1, 2.5, -3]


def test_joints_need_forward_kinematics_if_they_are_alone(table):
    path = table("pose_id,q1_deg,q2_mm\n0,90,1\n1,45,2\n")
    with pytest.raises(InputError, match=r"forward kinematics \(forward=\)"):
        read_poses(path)

    def forward(q):
        np.testing.assert_allclose(q, [[np.pi / 2, 1], [np.pi / 4, 2]])
        return RigidTransform(R=np.tile(np.eye(3), (2, 1, 1)), t=np.ones((2, 3)), source=Frame.M, target=Frame.H)

    assert read_poses(path, forward=forward).q.shape == (2, 2)


def test_joints_with_a_gap_are_refused(table):
    with pytest.raises(InputError, match="without a gap"):
        read_poses(table("pose_id,q1_deg,q3_deg\n0,1,2\n"))


# -- bad input ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("column", "instead", "message"),
    [
        ("x_mm", "x", "column 'x' has no unit; write 'x_mm'"),
        ("rx_deg", "rx", "column 'rx' has no unit; write 'rx_deg'"),
        ("x_mm", "x_m", "column 'x_m' is in another unit; convert it to 'x_mm'"),
        ("x_mm", "x_um", "column 'x_um' is in another unit"),
    ],
)
def test_a_missing_or_other_unit_is_named(table, column, instead, message):
    with pytest.raises(UnitError, match=message):
        read_poses(table(GOOD.replace(column, instead)))


def test_an_unknown_column_is_named_with_the_known_ones(table):
    with pytest.raises(InputError, match=r"column 'temperature' is unknown; known are: pose_id, x_mm, .*alpha_deg"):
        read_poses(table(f"{HEAD},temperature\n0,-10,0,10,0,5,0,20.1\n"))


def test_a_misspelt_column_gets_a_hint(table):
    with pytest.raises(InputError, match="did you mean 'pose_id'"):
        read_poses(table(GOOD.replace("pose_id", "pose-id")))


def test_a_column_of_another_convention_says_so(table):
    text = GOOD.replace("rx_deg,ry_deg,rz_deg", "a_deg,b_deg,c_deg")
    with pytest.raises(ConventionError, match=r"'a_deg' belongs to convention kuka.*convention is pi-hexapod"):
        read_poses(table(text))


def test_an_unknown_convention_is_named_with_the_known_ones(table):
    with pytest.raises(ConventionError, match=r"unknown convention 'newport'; known are: pi-hexapod, .*rotvec"):
        read_poses(table("# convention: newport\n" + GOOD))


def test_an_unknown_source_is_refused(table):
    with pytest.raises(ConventionError, match="'encoder' or 'set' is needed"):
        read_poses(table("# source: guess\n" + GOOD))


def test_a_pivot_without_unit_is_refused(table):
    with pytest.raises(UnitError, match="unknown comment key 'pivot'"):
        read_poses(table("# pivot: 1, 2, 3\n" + GOOD))


def test_a_pivot_that_is_no_point_is_refused(table):
    with pytest.raises(InputError, match="three numbers 'x, y, z' in mm"):
        read_poses(table("# pivot_mm: 1, 2\n" + GOOD))


def test_a_pivot_that_changes_within_the_table_is_refused(table):
    with pytest.raises(InputError, match=r"line 5: pivot_mm changes from '0, 0, 1' to '0, 0, 2'"):
        read_poses(table("# pivot_mm: 0, 0, 1\n" + GOOD + "# pivot_mm: 0, 0, 2\n2,0,0,0,0,0,3\n"))


@pytest.mark.parametrize(
    ("cell", "message"),
    [
        ("", "the cell is blank"),
        ("nan", "'nan' is no finite number"),
        ("inf", "'inf' is no finite number"),
        ("1e999", "too large"),
        ("abc", "'abc' is no finite number"),
        ("1_000", "'1_000' is no finite number"),
        ("9999", "9999 denotes a missing value"),
        ("-9999.9", "-9999.9 denotes a missing value"),
        ("99999.000", "denotes a missing value"),
    ],
)
def test_a_cell_that_is_no_number_is_named_by_row_and_column(table, cell, message):
    with pytest.raises(InputError, match=r"row 2 \(line 3\), column y_mm: .*" + message):
        read_poses(table(GOOD.replace("0.5", cell)))


def test_a_row_with_too_many_cells_hints_at_decimal_commas(table):
    with pytest.raises(InputError, match=r"line 3 has 8 cells, the header 7 columns \(decimal commas"):
        read_poses(table(GOOD.replace("0.5", "0,5")))


def test_mixed_decimal_marks_are_refused(table):
    with pytest.raises(InputError, match=r"decimal commas \(0,5\) and with points \(1.5\)"):
        read_poses(table(GOOD.replace(",", ";").replace("0.5", "0,5").replace("-10;0;10", "1.5;0;10")))


def test_duplicate_ids_are_refused(table):
    with pytest.raises(InputError, match="pose_id '0' appears in rows 1 and 2"):
        read_poses(table(GOOD.replace("\n1,", "\n0,")))


def test_duplicate_images_are_refused_unless_the_ball_differs(table):
    rows = f"{HEAD},image\n0,-10,0,10,0,5,0,a.tif\n1,10,1,-10,0,-5,1,a.tif\n"
    with pytest.raises(InputError, match=r"image 'a.tif' appears in rows 1 and 2"):
        read_poses(table(rows))
    two = f"{HEAD},image,ball_id\n0,-10,0,10,0,5,0,a.tif,0\n1,10,1,-10,0,-5,1,a.tif,1\n"
    assert read_poses(table(two)).image == ("a.tif", "a.tif")


def test_a_repeated_column_is_refused(table):
    with pytest.raises(InputError, match="column 'x_mm' appears more than once"):
        read_poses(table(GOOD.replace("y_mm", "x_mm")))


def test_a_missing_column_is_named(table):
    with pytest.raises(InputError, match="columns z_mm are missing"):
        read_poses(table("pose_id,x_mm,y_mm,rx_deg,ry_deg,rz_deg\n0,1,2,0,0,5\n"))
    with pytest.raises(InputError, match="column 'pose_id' is missing"):
        read_poses(table("x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg\n1,2,3,0,0,5\n"))
    with pytest.raises(InputError, match=r"the pose columns x_mm, .* are missing"):
        read_poses(table("pose_id,image\n0,a.tif\n"))


def test_a_half_given_set_pose_is_refused(table):
    with pytest.raises(InputError, match=r"columns y_set_mm, .* are missing beside x_set_mm"):
        read_poses(table(f"{HEAD},x_set_mm\n0,-10,0,10,0,5,0,-10\n"))


def test_source_set_beside_set_columns_is_contradictory(table):
    head = HEAD + ",x_set_mm,y_set_mm,z_set_mm,rx_set_deg,ry_set_deg,rz_set_deg"
    with pytest.raises(ConventionError, match="source: set"):
        read_poses(table(f"# source: set\n{head}\n0,1,2,3,0,0,5,1,2,3,0,0,5\n"))


def test_set_poses_that_belong_to_other_rows_give_a_warning(table):
    head = HEAD + ",x_set_mm,y_set_mm,z_set_mm,rx_set_deg,ry_set_deg,rz_set_deg"
    with pytest.warns(InputWarning, match="differ by 20 mm and 0 deg in row 2"):
        read_poses(table(f"{head}\n0,1,2,3,0,0,5,1,2,3,0,0,5\n1,1,2,23,0,0,5,1,2,3,0,0,5\n"))


def test_angles_that_look_like_radians_are_asked_about(table):
    small = GOOD.replace("5,0\n", "0.0873,0\n").replace("-5,1\n", "-0.0873,0.017453\n")
    with pytest.raises(UnitError, match=r"look like radians \(largest 0.0873, which is 5.002 deg if it is rad\)"):
        read_poses(table(small))


def test_large_round_angles_in_radians_are_asked_about(table):
    with pytest.raises(UnitError, match="look like radians"):
        read_poses(table(f"{HEAD}\n0,-10,0,10,3.14159,0,0.5236\n1,10,1,-10,3.14159,0.0,-0.5236\n"))


def test_a_plan_of_a_tenth_of_a_degree_can_be_confirmed(table):
    tenth = GOOD.replace("5,0\n", "0.1,0\n").replace("-5,1\n", "-0.1,0\n")
    with pytest.raises(UnitError, match="units: confirmed"):
        read_poses(table(tenth))
    by_comment = read_poses(table("# units: confirmed\n" + tenth))
    by_argument = read_poses(table(tenth), units_confirmed=True)
    assert_same(by_comment, by_argument)
    np.testing.assert_allclose(np.degrees(by_comment.T_MH.angles[0]), [0, 0.1, 0], atol=1e-12)


def test_no_rotation_at_all_is_no_unit_error(table):
    assert len(read_poses(table(f"{HEAD}\n0,-10,0,10,0,0,0\n1,10,0,-10,0,0,0\n"))) == 2


def test_angles_beyond_a_turn_are_no_degrees(table):
    with pytest.raises(UnitError, match="not an orientation in degrees"):
        read_poses(table(GOOD.replace("-5,1", "-5000,1")))


def test_rotation_vectors_in_degrees_are_asked_about(table):
    with pytest.raises(UnitError, match="more than one turn in radians"):
        read_poses(table("# convention: ur\npose_id,x_mm,y_mm,z_mm,rx_rad,ry_rad,rz_rad\n0,1,2,3,0,0,90\n"))


@pytest.mark.parametrize("factor", [0.001, 0.0002])
def test_positions_that_look_like_metres_are_asked_about(table, factor):
    with pytest.raises(UnitError, match="positions look like metres"):
        read_poses(table(f"{HEAD}\n0,{-10 * factor},0,0,0,5,0\n1,{10 * factor},0,0,0,-5,0\n"))


def test_positions_that_look_like_micrometres_are_asked_about(table):
    with pytest.raises(UnitError, match="positions look like micrometres"):
        read_poses(table(GOOD.replace("-10,", "-10000,")))


def test_encoder_noise_about_zero_is_no_unit_error(table):
    tilted = f"{HEAD}\n0,0.00013,-0.0004,0.0021,0,5.00002,0\n1,-0.0009,0.00007,0.0011,0,-4.9999,0\n"
    assert len(read_poses(table(tilted))) == 2
    circular = f"{HEAD}\n0,0.00013,-0.0004,0.0021,0.0001,0.0003,0\n1,-0.0009,0.00007,0.0011,0,-0.0004,0\n"
    assert len(read_poses(table(circular))) == 2


@pytest.mark.parametrize("alphas", [("0", "1.5707963"), ("0.7854", "3.1416")])
def test_table_angles_that_look_like_radians_are_asked_about(table, alphas):
    a, b = alphas
    with pytest.raises(UnitError, match="table angles look like radians"):
        read_poses(table(f"{HEAD},alpha_deg\n0,-10,0,10,0,5,0,{a}\n1,10,0,0,0,-5,1,{b}\n"))


def test_a_full_turn_of_table_angles_in_radians_is_asked_about(table):
    rows = "".join(f"{k},0,0,0,0,5,0,{2 * np.pi * k / 700!r}\n" for k in range(700))
    with pytest.raises(UnitError, match="table angles look like radians"):
        read_poses(table(f"{HEAD},alpha_deg\n{rows}"))


def test_units_that_contradict_the_columns_are_refused(table):
    with pytest.raises(UnitError, match="units are 'm, rad'"):
        read_poses(table("# units: m, rad\n" + GOOD))
    assert len(read_poses(table("# units: mm, deg\n" + GOOD))) == 2


def test_a_quaternion_that_is_not_unit_is_refused(table):
    with pytest.raises(InputError, match="row 1: quaternion has norm"):
        read_poses(table("# convention: quaternion-wxyz\npose_id,x_mm,y_mm,z_mm,qw,qx,qy,qz\n0,1,2,3,1,1,0,0\n"))


def test_bad_ball_ids_and_times_are_refused(table):
    with pytest.raises(InputError, match=r"column ball_id: 0.5 is no whole number"):
        read_poses(table(f"{HEAD},ball_id\n0,1,2,3,0,5,0,0.5\n"))
    with pytest.raises(InputError, match="'yesterday' is no ISO 8601 time"):
        read_poses(table(f"{HEAD},time_utc\n0,1,2,3,0,5,0,yesterday\n"))
    with pytest.raises(InputError, match="with and without a time zone"):
        read_poses(table(f"{HEAD},time_utc\n0,1,2,3,0,5,0,2026-01-01T00:00:00Z\n1,1,2,3,0,5,1,2026-01-01T00:00:01\n"))


def test_a_clock_that_runs_backwards_gives_a_warning(table):
    with pytest.warns(InputWarning, match="row 2 .* the clock runs backwards"):
        read_poses(table(f"{HEAD},time_utc\n0,1,2,3,0,5,0,2026-01-01T00:00:01Z\n1,1,2,3,0,5,1,2026-01-01T00:00:00Z\n"))


def test_files_that_are_no_tables_are_refused(table, tmp_path):
    with pytest.raises(FileError, match="does not exist"):
        read_poses(tmp_path / "none.csv")
    with pytest.raises(FileError, match="is a folder; a pose table is needed"):
        read_poses(tmp_path)
    with pytest.raises(InputError, match="no header line"):
        read_poses(table(""))
    with pytest.raises(InputError, match="holds no rows"):
        read_poses(table(HEAD + "\n"))
    with pytest.raises(FileError, match="UTF-16"):
        read_poses(table(GOOD.encode("utf-16")))
    with pytest.raises(FileError, match="no UTF-8 text"):
        read_poses(table(b"# \xb5m\n" + GOOD.encode()))


def test_nothing_is_overwritten_without_force(tmp_path, rng):
    poses = random_poses(rng)
    write_poses(tmp_path / "poses.csv", poses)
    before = (tmp_path / "poses.csv").read_bytes()
    with pytest.raises(FileError, match="exists already"):
        write_poses(tmp_path / "poses.csv", poses)
    write_poses(tmp_path / "poses.csv", poses, force=True)
    assert (tmp_path / "poses.csv").read_bytes() == before


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.text(alphabet="pose_id,xyzmr\n\t;#:0123456789.-e \ufeff", max_size=120) | st.binary(max_size=60))
def test_no_text_makes_the_reader_fail_otherwise_than_on_purpose(tmp_path, text):
    path = tmp_path / "fuzz.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        with pytest.raises((InputError, FileError)):
            read_poses(path)


def robot_table(tmp_path, convention, scale, comment=""):
    columns = {"ur": "rx_rad,ry_rad,rz_rad", "kuka": "a_deg,b_deg,c_deg", "pi-hexapod": "rx_deg,ry_deg,rz_deg"}
    rows = [f"{k},{0.51 * scale},{-0.05 * scale},{(0.58 + 0.01 * k) * scale},1.5,0.2,-0.7" for k in range(5)]
    head = [f"# convention: {convention}", *comment.splitlines(), f"pose_id,x_mm,y_mm,z_mm,{columns[convention]}"]
    path = tmp_path / "robot.csv"
    path.write_text("\n".join([*head, *rows]) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize("convention", ["ur", "kuka"])
def test_metres_in_a_robots_table_are_named_and_may_be_confirmed(tmp_path, convention):
    with pytest.raises(UnitError, match=r"x_mm, y_mm, z_mm: positions look like metres \(largest 0\.62, which is 620"):
        read_poses(robot_table(tmp_path, convention, 1.0))
    assert read_poses(robot_table(tmp_path, convention, 1000.0)).T_MH.t[0, 0] == 510.0
    assert read_poses(robot_table(tmp_path, convention, 1.0, "# units: confirmed")).units_confirmed
    # a hexapod's plan of half a millimetre is one
    assert read_poses(robot_table(tmp_path, "pi-hexapod", 1.0)).T_MH.t[0, 0] == 0.51


def test_a_robots_small_table_that_was_written_is_read_back(tmp_path):
    poses = read_poses(robot_table(tmp_path, "pi-hexapod", 1.0))
    write_poses(tmp_path / "back.csv", poses, convention="kuka")
    np.testing.assert_allclose(read_poses(tmp_path / "back.csv").T_MH.matrix, poses.T_MH.matrix, atol=1e-12)
