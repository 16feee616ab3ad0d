"""Pose logs as controllers and people write them: each kind by a file in its own layout, refusals by their reason."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import tomopose as tp
from tomopose.errors import ConventionError, FileError, InputError, UnitError
from tomopose.io.foreign.pose_log import table_text
from tomopose.planning.commands import WRITERS, command_list

KINDS = [
    "scan.dat", "scan.src", "rsi.xml", "scan.mod", "scan.script", "rtde.csv", "scan.ls", "record.dat", "terminal.txt",
    "qpos.txt", "poses4x4.txt", "Punkte.csv",
]  # fmt: skip


@pytest.fixture
def write(tmp_path):
    def write(name: str, text: str, encoding: str = "utf-8") -> Path:
        path = tmp_path / name
        path.write_text(text, encoding=encoding)
        return path

    return write


# -- each kind -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", KINDS)
def test_each_kind_of_log_gives_the_poses_that_its_numbers_mean(name, shared_data, tmp_path):
    folder = shared_data / "cases" / "pose-logs"
    T = np.array(json.loads((folder / "expected.json").read_text())[name])
    log = tp.read_pose_log(folder / name)
    (tmp_path / "poses.csv").write_text(table_text(log.table()))
    poses = tp.read_poses(tmp_path / "poses.csv")
    np.testing.assert_allclose(poses.T_MH.R, T[:, :3, :3], rtol=0, atol=1e-12)
    np.testing.assert_allclose(poses.T_MH.t, T[:, :3, 3], rtol=0, atol=1e-9)


def test_a_table_holds_the_digits_of_the_log(write):
    log = tp.read_pose_log(write("log.txt", "POS?\nX=-0.0000100\nY=1.20\nZ=3\nU=0.10\nV=-0.0000\nW=5e-3\n"))
    assert log.rows == (("-0.0000100", "1.20", "3", "0.10", "-0.0000", "5e-3"),)
    assert "-0.0000100,1.20,3,0.10,-0.0000,5e-3" in table_text(log.table())


POINT = "{UF : 1, UT : 2, CONFIG : 'N U T', X = 612.5 mm, Y = -30 mm, Z = 410 mm, W = 179 deg, P = 1 deg, R = 12 deg}"
FANUC = "/PROG SCAN\n/MN\n   1:L P[1] 100mm/sec FINE ;\n   2:L P[2] 100mm/sec FINE ;\n/POS\n" + "".join(
    f"P[{k}]{{\n   GP1:\n{POINT[1:-1]}\n}};\n" for k in (1, 2)
)
YASKAWA = (
    "/JOB\n//NAME SCAN\n//POS\n///USER 1\n///TOOL 0\n///POSTYPE USER\n///RECTAN\n"
    "P00001=612.5,-30,410,179.5,0.25,12\nP00002=622.5,-30,410,179.5,0.25,12\n"
    "//INST\nNOP\nMOVL P00001 V=100.0\nMOVL P00002 V=100.0\nEND\n"
)
TARGET = "[[{x},-20.5,433.1],[0.7071068,0,0.7071068,0],[0,0,-1,0],[9E+09,9E+09,9E+09,9E+09,9E+09,9E+09]]"
RAPID = f"""MODULE Scan
  PERS tooldata tBall:=[TRUE,[[0,0,120],[1,0,0,0]],[1,[0,0,1],[1,0,0,0],0,0,0]];
  PERS wobjdata wTable:=[FALSE,TRUE,"",[[500,0,400],[1,0,0,0]],[[0,0,0],[1,0,0,0]]];
  VAR pose peShift:=[[1,2,3],[1,0,0,0]];
  LOCAL CONST robtarget p10:=
    {TARGET.format(x=600)};
  VAR robtarget p20;
  PROC main()
    MoveJ P10, v100, fine, tBall\\WObj:=wTable;
    MoveL {TARGET.format(x=610)}, v100, fine, tBall\\WObj:=wTable;
    p20 := {TARGET.format(x=620)};
    MoveL p20, v100, fine, tBall\\WObj:=wTable;
    p20 := {TARGET.format(x=630)};
    MoveL p20, v100, fine, tBall\\WObj:=wTable;
    MoveL p10, v100, fine, tBall\\WObj:=wTable;
  ENDPROC
ENDMODULE
"""


def test_a_rapid_module_gives_the_targets_of_its_moves_and_no_tool_or_work_object(write):
    log = tp.read_pose_log(write("scan.mod", RAPID))
    assert [float(row[0]) for row in log.rows] == [600, 610, 620, 630, 600]
    assert log.pose_id == ("p10", "line 10", "p20", "p20#2", "p10#2")


def test_a_target_of_another_module_is_refused_because_the_poses_after_it_would_move_up(write):
    with pytest.raises(InputError, match="line 15: the file does not hold the target 'p30'"):
        tp.read_pose_log(write("scan.mod", RAPID.replace("MoveL p10, v100", "MoveL p30, v100")))


def test_frames_of_a_kuka_list_are_no_poses_beside_its_positions(write):
    point = "{X 812.5,Y -12.25,Z 905,A 12.5,B -3.25,C 178.5"
    text = "DEFDAT RUN\nDECL FRAME BALL={X 0.0,Y 0.0,Z 120.0,A 0.0,B 0.0,C 0.0}\n"
    log = tp.read_pose_log(write("run.dat", text + f"DECL E6POS XP1={point},S 2,T 2}}\nENDDAT\n"))
    assert log.pose_id == ("XP1",)
    assert "frames that no move visits are left out: BALL" in log.notes
    alone = tp.read_pose_log(write("frames.dat", f"DEFDAT RUN\nDECL FRAME F1={point}}}\nENDDAT\n"))
    assert alone.pose_id == ("F1",)


def test_a_script_target_that_is_assigned_anew_counts_as_it_is_at_each_move(write):
    lines = ["def scan():"]
    for x in (0.45, 0.46):
        lines += [f"  target=p[{x},-0.12,0.33,0,3.14,0]", "  movel(target, a=1.2, v=0.25)"]
    lines += ["  movel(p[0.47,-0.12,0.33,0,3.14,0], a=1.2, v=0.25)", "end"]
    log = tp.read_pose_log(write("scan.script", "\n".join(lines)))
    assert [float(row[0]) for row in log.rows] == [450, 460, 470]
    assert log.pose_id == ("target", "target#2", "line 6")


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("scan.ls", "FINE", "FINE INC"),
        ("scan.ls", "FINE", "FINE Offset,PR[3]"),
        ("scan.jbi", "MOVL P00002 V=100.0", "IMOV P00002 V=100.0"),
    ],
)
def test_a_move_that_is_relative_or_shifted_is_refused(name, old, new, write):
    text = FANUC if name == "scan.ls" else YASKAWA
    assert len(tp.read_pose_log(write(name, text)).rows) == 2
    with pytest.raises(InputError, match=r"does not state|relative to where"):
        tp.read_pose_log(write("shifted." + name.rpartition(".")[2], text.replace(old, new)))


def test_moves_to_registers_that_a_listing_does_not_hold_are_named(write):
    log = tp.read_pose_log(write("scan.ls", FANUC.replace("/POS", "   3:J PR[1:HOME] 100% FINE ;\n/POS")))
    assert any("PR[1:HOME]" in note for note in log.notes)


@pytest.mark.parametrize("language", list(WRITERS))
def test_what_plan_writes_as_commands_is_read_back_to_the_same_poses(language, write, rng):
    n = 12
    poses = tp.PoseSequence.from_table(
        rng.uniform(-9, 9, (n, 3)),
        rng.uniform(-8, 8, (n, 3)),
        pose_id=[f"p{k} a" for k in range(n)],
        alpha=np.radians(np.repeat([0.0, 90.0, 180.0], 4)),
        pivot=[0.0, 1.5, 80.0],
    )
    back = tp.read_pose_log(write("run.txt", command_list(poses, language))).poses()
    assert back.pose_id == poses.pose_id
    np.testing.assert_allclose(back.T_MH.t, poses.T_MH.t, rtol=0, atol=1e-6)
    np.testing.assert_allclose(back.T_MH.R, poses.T_MH.R, rtol=0, atol=2e-8)
    np.testing.assert_allclose(back.alpha, poses.alpha, rtol=0, atol=1e-8)
    assert back.source == "set"
    if language == "pi-gcs":
        np.testing.assert_array_equal(back.pivot, poses.pivot)


# -- robots ------------------------------------------------------------------------------------------------------------

DAT = """DEFDAT RUN
DECL E6POS XP1={X 1.0,Y 2.0,Z 3.0,A 10,B 20,C 30,S 2,T 35}
DECL FDAT FP1={TOOL_NO 2,BASE_NO 1,IPO_FRAME #BASE}
DECL E6POS XP2={X 4.0,Y 5.0,Z 6.0,A -10,B -20,C -30,S 2,T 35}
DECL FDAT FP2={TOOL_NO TOOL2,BASE_NO 1,IPO_FRAME #BASE}
DECL E6AXIS XHOME={A1 0,A2 -90,A3 90,A4 0,A5 10,A6 0}
ENDDAT
"""


def test_a_kuka_program_takes_its_points_from_the_list_beside_it(write):
    write("run.dat", DAT.replace("TOOL2", "2"))
    program = write("run.src", "DEF RUN()\nPTP HOME\nLIN XP2 C_DIS\nWAIT SEC 1\nSLIN XP1 WITH $VEL=X\nPTP XHOME\nEND\n")
    log = tp.read_pose_log(program)
    assert log.pose_id == ("XP2", "XP1")
    assert [row[0] for row in log.rows] == ["4.0", "1.0"]
    assert any("HOME" in note for note in log.notes)


def test_a_kuka_program_without_its_list_says_which_file_is_missing(write):
    with pytest.raises(InputError, match=r"line 2: the position of XP1 is in run\.dat; put that file beside"):
        tp.read_pose_log(write("run.src", "DEF RUN()\nLIN XP1\nEND\n"))


def test_poses_of_two_tools_are_refused(write):
    with pytest.raises(InputError, match="the tool number changes from 2 to 3 between the poses"):
        tp.read_pose_log(write("run.dat", DAT.replace("TOOL2", "3")))


@pytest.mark.parametrize(
    ("name", "text", "reason"),
    [
        ("a.src", "DEF A()\nLIN_REL {X 10}\nEND\n", "relative to the pose before it"),
        ("a.src", "DEF A()\nLIN {X 10, Y 1}\nEND\n", "lacks Z, A, B, C"),
        ("a.mod", "MODULE m\nCONST robtarget p:=[[1,2,3],[1,0,0,0]];\nMoveL Offs(p,0,0,9),v,fine,t;\n", "is computed"),
        ("a.script", "def a():\n  movel(pose_trans(x, p[0,0,0,0,0,0]), a=1)\nend\n", "is computed"),
        ("a.ls", "/PROG A\n/POS\nP[1]{ GP1: UF : 0, UT : 1, X = 1 mm };\n/END\n", "no point has X, Y, Z, W, P and R"),
        ("a.jbi", "/JOB\n//NAME A\n//POS\n///PULSE\nC00000=1,2,3,4,5,6\n//INST\n", "encoder pulses"),
    ],
)  # fmt: skip
def test_poses_that_a_file_does_not_state_are_refused_with_how_to_proceed(name, text, reason, write):
    with pytest.raises(InputError, match=reason):
        tp.read_pose_log(write(name, text))


def test_of_a_universal_robots_script_the_tool_is_no_pose_and_millimetres_are_no_metres(write):
    text = "def a():\n  set_tcp(p[0, 0, 0.1, 0, 0, 0])\n  w1 = p[0.1, 0.2, 0.3, 0, 0, 1]\n"
    text += "  movej([0,0,0,0,0,0])\n  movel(w1)\nend\n"
    log = tp.read_pose_log(write("a.script", text))
    assert log.rows == (("100", "200", "300", "0", "0", "1"),)
    assert log.pose_id == ("w1",)
    with pytest.raises(UnitError, match="add --units mm"):
        tp.read_pose_log(write("b.script", "movel(p[100.0, 200, 300, 0, 0, 1])\n"))


def test_a_fanuc_listing_with_a_second_group_and_comments(write):
    text = """/PROG  CALIB
/ATTR
OWNER = MNEDITOR;
/MN
   1:  UTOOL_NUM=0 ;
   2:L P[2:far] 100mm/sec CNT100    ;
   3:J P[1] 100% FINE    ;
/POS
P[1]{
   GP1:
\tUF : 0, UT : 0,\t\tCONFIG : 'N U T, 0, 0, 0',
\tX = -1371.166  mm,\tY =  2539.539  mm,\tZ =  -538.770  mm,
\tW =  -175.187 deg,\tP =   -34.176 deg,\tR =     8.232 deg
   GP2:
\tUF : 0, UT : 0,
\tJ1=     6.425 deg
};
P[2:far]{
   GP1:
\tUF : 0, UT : 0,\t\tCONFIG : 'N U T, 0, 0, 0',
\tX = 1.5  mm,\tY =  2  mm,\tZ =  3  mm,
\tW =  10 deg,\tP =   20 deg,\tR =     30 deg
};
/END
"""
    log = tp.read_pose_log(write("calib.ls", text))
    assert log.pose_id == ("P2", "P1")
    assert log.rows[1] == ("-1371.166", "2539.539", "-538.770", "-175.187", "-34.176", "8.232")
    assert any("GP2" in note for note in log.notes)
    R = Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_matrix()
    np.testing.assert_allclose(log.poses().T_MH.R[0], R, atol=1e-12)


def test_a_yaskawa_job_with_rectangular_positions(write):
    text = """/JOB
//NAME RUN
//POS
///NPOS 2,0,0,0,0,0
///TOOL 3
///POSTYPE BASE
///RECTAN
///RCONF 0,0,0,0,0,0,0,0
C00000=1020.5,0.0,1000.0,180.0,0.0,10.0
C00001=1030.5,5.0,1000.0,179.0,1.0,20.0
//INST
///ATTR SC,RW
NOP
MOVJ C00001 VJ=50.00
MOVL C00000 V=50.0
END
"""
    log = tp.read_pose_log(write("run.jbi", text))
    assert log.pose_id == ("C00001", "C00000")
    assert log.rows[0] == ("1030.5", "5.0", "1000.0", "179.0", "1.0", "20.0")
    assert "tool 3 in BASE" in log.notes[-1]


def test_staubli_points_leave_out_what_is_zero(write):
    text = """<?xml version="1.0" encoding="utf-8"?>
<Database xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" xmlns="http://www.staubli.com/robotics/VAL3/Data/2">
  <Datas>
    <Data name="jPark" access="public" xsi:type="array" type="jointRx" size="1"><Value key="0" j3="90" /></Data>
    <Data name="pBall" access="private" xsi:type="array" type="pointRx" size="3">
      <Value key="0" x="169.83" y="700.03" z="372.39" rx="-179.9" rz="88.8" fatherId="fCell[0]" />
      <Value key="1" x="1" rx="10" ry="20" rz="30" fatherId="fCell[0]" />
      <Value key="2" fatherId="fCell[0]" />
    </Data>
  </Datas>
</Database>
"""
    log = tp.read_pose_log(write("run.dtx", text))
    assert log.pose_id == ("pBall[0]", "pBall[1]")
    assert log.rows[0] == ("169.83", "700.03", "372.39", "-179.9", "0", "88.8")
    R = Rotation.from_euler("XYZ", [10, 20, 30], degrees=True).as_matrix()
    np.testing.assert_allclose(log.poses().T_MH.R[1], R, atol=1e-12)


def test_joint_positions_alone_become_joint_columns(write):
    text = "DEFDAT A\nDECL E6AXIS XP1={A1 10,A2 -90,A3 90,A4 7,A5 10,A6 0.5}\nDECL E6AXIS XP2={A1 12,A2 -80,A3 90,A4 7,"
    text += "A5 10,A6 0.5}\n"
    log = tp.read_pose_log(write("a.dat", text))
    assert not log.rows
    assert log.table().columns == ("pose_id", "q1_deg", "q2_deg", "q3_deg", "q4_deg", "q5_deg", "q6_deg")
    np.testing.assert_allclose(np.degrees(log.poses().q[0]), [10, -90, 90, 7, 10, 0.5])


def test_controllers_that_write_windows_text_are_read(write):
    text = (
        "&ACCESS RVP\nDEF A()\n; Prüfkörper links\nLIN {X 1, Y 2, Z 3, A 4, B 5, C 6}\nLIN {X 2, Y 2, Z 3, A 4, B 5, "
    )
    text += "C 6}\nEND\n"
    assert len(tp.read_pose_log(write("a.src", text, "cp1252"))) == 2
    assert len(tp.read_pose_log(write("b.src", text, "utf-16"))) == 2


# -- PI ------------------------------------------------------------------------------------------------------------


def test_a_recording_that_is_cut_off_or_lacks_an_axis_is_refused(shared_data, write):
    text = (shared_data / "cases" / "pose-logs" / "record.dat").read_text()
    with pytest.raises(FileError, match="announces 4 rows, 3 follow"):
        tp.read_pose_log(write("a.dat", text.rsplit("\n", 2)[0] + "\n"))
    with pytest.raises(InputError, match=r"no recorded position of axis W; .*Error of Axis AXIS:W"):
        tp.read_pose_log(write("b.dat", text.replace("Actual Position of Axis AXIS:W", "Error of Axis AXIS:W")))


def test_commanded_positions_of_a_recording_are_the_set_poses(write):
    axes = "XYZUVW"
    names = [f"Actual Position of Axis AXIS:{a}" for a in axes] + [f"Target Position of Axis AXIS:{a}" for a in axes]
    head = ["# REM C-887", "# SEPARATOR = 32", "# DIM = 12", "# SAMPLE_TIME = 0.1", "# NDATA = 2"]
    head += [f"# NAME{k} = {n}" for k, n in enumerate(names)] + ["# END_HEADER"]
    log = tp.read_pose_log(write("a.dat", "\n".join([*head, *(" ".join(map(str, range(12))) for _ in range(2))])))
    assert log.rows[0] == tuple("012345")
    assert log.set_rows[0] == ("6", "7", "8", "9", "10", "11")
    np.testing.assert_allclose(log.seconds, [0, 0.1])


# -- matrices ------------------------------------------------------------------------------------------------------


def matrices(n=3):
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, :3] = Rotation.from_euler("xyz", [[10, 20, 30], [-5, 3, 2], [0, 0, 180]], degrees=True).as_matrix()[:n]
    T[:, :3, 3] = [[0.5, -0.1, 0.7], [0.6, 0.2, 0.7], [0.4, 0.0, 0.8]][:n]
    return T


@pytest.mark.parametrize("way", ["npy", "json", "rows of 16", "columns first"])
def test_matrices_in_many_wrappings(way, tmp_path):
    T, path = matrices(), tmp_path / ("a.npy" if way == "npy" else "a.json" if way == "json" else "a.txt")
    if way == "npy":
        np.save(path, T)
    elif way == "json":
        path.write_text(json.dumps({"poses": T.tolist(), "camera": "x"}))
    else:
        np.savetxt(path, (np.swapaxes(T, 1, 2) if way == "columns first" else T).reshape(-1, 16), fmt="%.17g")
    with pytest.raises(UnitError, match=r"not stated; add --units mm"):
        tp.read_pose_log(path)
    poses = tp.read_pose_log(path, units="m").poses()
    np.testing.assert_allclose(poses.T_MH.t, 1000 * T[:, :3, 3], atol=1e-9)
    np.testing.assert_allclose(poses.T_MH.R, T[:, :3, :3], atol=1e-12)


def test_a_matrix_that_is_no_rotation_is_refused(tmp_path):
    T = matrices()
    T[1, :3, 0] *= -1
    np.save(tmp_path / "a.npy", T)
    with pytest.raises(InputError, match="matrix 1 is not a rotation"):
        tp.read_pose_log(tmp_path / "a.npy", units="mm")


# -- tables --------------------------------------------------------------------------------------------------------

ROWS = "1;10;20;30;4;5;6\n2;11;21;31;5;6;7\n"


def test_rotations_that_several_makers_write_so_need_a_word(write):
    path = write("a.csv", "Nr;X [mm];Y [mm];Z [mm];RX [deg];RY [deg];RZ [deg]\n" + ROWS)
    with pytest.raises(ConventionError, match=r"say whose they are: --convention pi-hexapod \| symetrie-hexapod"):
        tp.read_pose_log(path)
    log = tp.read_pose_log(path, convention="yaskawa")
    R = Rotation.from_euler("xyz", [4, 5, 6], degrees=True).as_matrix()
    np.testing.assert_allclose(log.poses().T_MH.R[0], R, atol=1e-12)


def test_columns_by_name_or_by_number(write):
    named = write("a.csv", "Punkt;p_links;p_vorn;p_oben;w1;w2;w3\n" + ROWS)
    with pytest.raises(InputError, match="name them: --convention kuka --columns"):
        tp.read_pose_log(named)
    roles = {"x": "p_links", "y": "p_vorn", "z": "p_oben", "a": "w1", "b": "w2", "c": "w3"}
    log = tp.read_pose_log(named, convention="kuka", columns=roles)
    assert log.rows[0] == ("10", "20", "30", "4", "5", "6")
    assert log.pose_id == ("1", "2")
    bare = write("b.csv", ROWS)
    numbers = {"x": "2", "y": "3", "z": "4", "r1": "5", "r2": "6", "r3": "7", "pose_id": "1"}
    assert tp.read_pose_log(bare, convention="kuka", columns=numbers).rows == log.rows
    with pytest.raises(InputError, match=r"--columns x=Xq: there is no column 'Xq'"):
        tp.read_pose_log(named, convention="kuka", columns={**roles, "x": "Xq"})


@pytest.mark.parametrize(
    ("text", "row"),
    [
        ("X_m,Y_m,Z_m,A,B,C\n0.1234,0.2,0.3,4,5,6\n0.1,0.2,0.31,4,5,6\n", ("123.4", "200", "300", "4", "5", "6")),
        ("# run 7\nx y z u v w\nmm mm mm deg deg deg\n1 2 3 4 5 6\n2 2 3 4 5 6\n", ("1", "2", "3", "4", "5", "6")),
        ("X\tY\tZ\tW\tP\tR\n1,5\t2\t3\t4\t5\t6\n2,5\t2\t3\t4\t5\t6\n", ("1.5", "2", "3", "4", "5", "6")),
        ("my cell\nx_mm,y_mm,z_mm,qw,qx,qy,qz\n1,2,3,1,0,0,0\n2,2,3,1,0,0,0\n", ("1", "2", "3", "1", "0", "0", "0")),
    ],
)
def test_separators_units_and_headers_are_found(text, row, write):
    assert tp.read_pose_log(write("a.csv", text)).rows[0] == row


def test_set_columns_images_and_table_angles_of_a_table_are_kept(write):
    head = "image,alpha_deg,X_mm,Y_mm,Z_mm,A,B,C,X_soll_mm,Y_soll_mm,Z_soll_mm,A_soll,B_soll,C_soll,time\n"
    row = "{0}.tif,90,1.01,2,30,4,5,6,1,2,30,4,5,6,2026-03-03T10:00:0{0}\n"
    log = tp.read_pose_log(write("a.csv", head + row.format(1) + row.format(2)))
    poses = log.poses()
    assert poses.image == ("1.tif", "2.tif")
    np.testing.assert_allclose(poses.alpha, np.pi / 2)
    np.testing.assert_allclose(poses.T_MH_set.t[0], [1, 2, 30])
    assert poses.time_utc == ("2026-03-03T10:00:01", "2026-03-03T10:00:02")


# -- joining by time -----------------------------------------------------------------------------------------------

CLOCKED = "time;X_mm;Y_mm;Z_mm;U;V;W\n100.0;0;0;0;0;0;0\n100.5;1;0;0;0;0;10\n101.0;2;0;0;0;0;20\n110.0;3;0;0;0;0;20\n"


def test_images_are_joined_by_time_with_the_interpolation_said(write):
    log = write("log.csv", CLOCKED)
    images = write("images.csv", "image,time\na.tif,100.5\nb.tif,100.75\n")
    joined = tp.read_pose_log(log, join=images)
    poses = joined.poses()
    assert poses.image == ("a.tif", "b.tif")
    np.testing.assert_allclose(poses.T_MH.t, [[1, 0, 0], [1.5, 0, 0]])
    R = Rotation.from_euler("z", 15, degrees=True).as_matrix()
    np.testing.assert_allclose(poses.T_MH.R[1], R, atol=1e-12)
    assert joined.rows[0] == ("1", "0", "0", "0", "0", "10")
    assert "positions are interpolated linearly" in joined.notes[-1]


def test_a_gap_of_the_log_is_not_bridged_unless_it_is_allowed(write):
    log, images = write("log.csv", CLOCKED), write("images.csv", "image,time\na.tif,105\nb.tif,106\n")
    with pytest.raises(InputError, match=r"near image a\.tif .*the gap there is 9 s long, 1 s are allowed"):
        tp.read_pose_log(log, join=images)
    t = tp.read_pose_log(log, join=images, longest_gap_s=10).poses().T_MH.t
    np.testing.assert_allclose(t[0, 0], 2 + 4 / 9)


def test_times_outside_the_log_and_other_clocks_are_refused(write):
    log = write("log.csv", CLOCKED)
    late = write("late.csv", "image,time\na.tif,100.5\nb.tif,200\n")
    with pytest.raises(InputError, match=r"image b\.tif \(time 200\) lies outside the log, by 90 s"):
        tp.read_pose_log(log, join=late)
    shifted = tp.read_pose_log(log, join=write("s.csv", "image,time\na.tif,40.5\nb.tif,41\n"), clock_offset_s=60)
    np.testing.assert_allclose(shifted.poses().T_MH.t[:, 0], [1, 2])
    with pytest.raises(InputError, match="its clock is seconds of a counter, that of the moments is time of day"):
        tp.read_pose_log(log, join=write("d.csv", "image,time\na.tif,10:00:00\nb.tif,10:00:01\n"))


def test_a_terminal_log_joins_images_by_the_time_of_its_replies(shared_data, write):
    log = shared_data / "cases" / "pose-logs" / "terminal.txt"
    images = write("i.csv", "image;time\na.tif;09:41:10.031\nb.tif;09:41:13,031\n")
    poses = tp.read_pose_log(log, join=images).poses()
    whole = tp.read_pose_log(log).poses()
    np.testing.assert_array_equal(poses.T_MH.t, whole.T_MH.t[[0, 3]])


# -- other files ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("part.xtekct", "[XTekCT]\nSrcToDetector=1000\n", "tomopose import-scanner part.xtekct --out scanner.json"),
        ("a.pdf", "%PDF-1.7 x", "PDF document"),
        ("a.png", "\x89PNG", "a PNG picture"),
        ("a.xlsx", "PK\x03\x04xx", "save the sheet as CSV UTF-8"),
        ("a.txt", "hello world\n", "write the poses as a table with a header"),
        ("a.txt", "", "the file is empty"),
    ],
)
def test_a_file_of_another_kind_is_answered_with_how_to_proceed(name, content, says, tmp_path):
    (tmp_path / name).write_bytes(content.encode("latin-1"))
    with pytest.raises(FileError, match=says):
        tp.read_pose_log(tmp_path / name)


def test_a_format_that_is_asked_for_and_not_there_is_refused(write):
    with pytest.raises(ConventionError, match="unknown format 'kuko' of poses; known are"):
        tp.read_pose_log(write("a.txt", "x"), format="kuko")
    with pytest.raises(InputError):
        tp.read_pose_log(write("a.txt", "hello\n"), format="fanuc")


def test_positions_that_a_kuka_controller_was_asked_for(write):
    path = write(
        "log.txt",
        "2025-03-02 10:11:12.125; $POS_ACT={E6POS: X 852.5, Y 12.25, Z 640.0, A 1.0, B 2.0, C 3.0, S 2, T 10}\n"
        "connection kept alive\n"
        "2025-03-02 10:11:14.125; $POS_ACT={E6POS: X 853.5, Y 12.25, Z 640.0, A 1.0, B 2.5, C 3.0, S 2, T 10}\n",
    )
    log = tp.read_pose_log(path)
    assert log.convention == "kuka"
    assert log.rows == (
        ("852.5", "12.25", "640.0", "1.0", "2.0", "3.0"),
        ("853.5", "12.25", "640.0", "1.0", "2.5", "3.0"),
    )
    np.testing.assert_allclose(np.diff(log.seconds), 2.0)


def test_a_move_to_the_joint_angles_of_a_pose_goes_to_that_pose(write):
    text = (
        "def prog():\n  set_tcp(p[0.0,0.0,0.15,0.0,0.0,0.0])\n  global wp_1_p=p[-.2401,.3101,.4501,1.2,-1.1,.5]\n"
        "  movej(get_inverse_kin(wp_1_p, qnear=[0,0,0,0,0,0]), a=1.4, v=1.05)\nend\n"
    )
    (row,) = tp.read_pose_log(write("a.script", text)).rows
    assert [float(w) for w in row] == [-240.1, 310.1, 450.1, 1.2, -1.1, 0.5]


def test_bracketed_tcp_poses_are_read_where_the_format_is_said(write):
    path = write("tcp.txt", "[0.1001, 0.2, 0.3, 0.0, 3.1, 0.1]\n[0.1101, 0.2, 0.3, 0.0, 3.0, 0.1]\n")
    log = tp.read_pose_log(path, format="ur")
    assert [float(w) for w in log.rows[1]] == [110.1, 200.0, 300.0, 0.0, 3.0, 0.1]
    with pytest.raises(InputError):
        tp.read_pose_log(path)


def test_a_terminal_s_prompt_is_no_part_of_the_query(write):
    reply = "X=1.25\nY=-0.5\nZ=2.0\nU=0.1\nV=-0.2\nW=3.0\n"
    log = tp.read_pose_log(write("t.txt", f"C-887>POS? X Y Z U V W\n{reply}C-887>POS? X Y Z U V W\n{reply}"))
    assert log.rows == (("1.25", "-0.5", "2.0", "0.1", "-0.2", "3.0"),) * 2


def test_matrices_by_named_columns_and_units_of_a_json_object(write):
    header = "name_less,r11,r12,r13,tx,r21,r22,r23,ty,r31,r32,r33,tz"
    table = write("m.csv", f"{header}\n0,1,0,0,10,0,1,0,20,0,0,1,30\n1,0,-1,0,11,1,0,0,20,0,0,1,30\n")
    for path, units in (
        (table, "mm"),
        (write("m.json", '{"units": "mm", "poses": [[[1,0,0,10],[0,1,0,20],[0,0,1,30],[0,0,0,1]],'
                         '[[0,-1,0,11],[1,0,0,20],[0,0,1,30],[0,0,0,1]]]}'), None),
    ):  # fmt: skip
        poses = tp.read_pose_log(path, units=units).poses()
        np.testing.assert_allclose(poses.T_MH.t, [[10, 20, 30], [11, 20, 30]])
        np.testing.assert_allclose(poses.T_MH.R[1], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
