"""Pose sequences as command lists of real machines.  Text only: sending it is the operator's business.

Every pose is reached, waited for, and announced by its pose_id, so that images and poses pair by name; where the table
has to turn, a comment says to which angle, since the table belongs to another controller.
"""

from __future__ import annotations

from collections.abc import Callable
from types import MappingProxyType

import numpy as np

from tomopose.errors import ConventionError
from tomopose.geometry.rotations import convention_from_rotation
from tomopose.manipulator.poses import PoseSequence
from tomopose.units import Array


def _alpha(poses: PoseSequence) -> Array:
    return np.degrees(poses.alpha)


def _table_lines(poses: PoseSequence, comment: str) -> list[list[str]]:
    """For every pose, the comment lines before it."""
    alpha = _alpha(poses)
    lines: list[list[str]] = []
    for k, a in enumerate(alpha):
        turned = k == 0 or abs(a - alpha[k - 1]) > 1e-9
        lines.append([f"{comment} table to {a:.6f} deg"] if turned else [])
    return lines


def pi_gcs(poses: PoseSequence) -> str:
    """PI General Command Set: absolute moves in mm and degrees (U, V, W of R_x R_y R_z), polled by ONT?."""
    angles = convention_from_rotation(poses.T_MH.R, "pi-hexapod")
    lines = ["; axes X Y Z (mm) U V W (deg); pivot as set by SPI"]
    if poses.pivot is not None:
        lines.append("SPI R {:.6f} S {:.6f} T {:.6f}".format(*poses.pivot))
    for k, table in enumerate(_table_lines(poses, ";")):
        x, a = poses.T_MH.t[k], angles[k]
        lines += [
            *table,
            f"; pose_id {poses.pose_id[k]}",
            f"MOV X {x[0]:.6f} Y {x[1]:.6f} Z {x[2]:.6f} U {a[0]:.6f} V {a[1]:.6f} W {a[2]:.6f}",
            "ONT? X Y Z U V W",
            "POS?",
        ]
    return "\n".join(lines) + "\n"


def kuka_krl(poses: PoseSequence, *, name: str = "tomopose_run") -> str:
    """KUKA Robot Language: linear moves in mm and degrees (A, B, C of R_z R_y R_x) in the active base and tool."""
    angles = convention_from_rotation(poses.T_MH.R, "kuka")
    lines = [f"DEF {name}()", "; set $BASE and $TOOL before; both must stay as in the calibration"]
    for k, table in enumerate(_table_lines(poses, ";")):
        x, a = poses.T_MH.t[k], angles[k]
        lines += [
            *table,
            f"; pose_id {poses.pose_id[k]}",
            f"LIN {{X {x[0]:.6f}, Y {x[1]:.6f}, Z {x[2]:.6f}, A {a[0]:.6f}, B {a[1]:.6f}, C {a[2]:.6f}}}",
            "WAIT SEC 1.0",
        ]
    return "\n".join([*lines, "END"]) + "\n"


def abb_rapid(poses: PoseSequence, *, name: str = "tomopose_run") -> str:
    """ABB RAPID: MoveL to robtargets, mm and quaternions (w, x, y, z), in the active tool and work object."""
    q = convention_from_rotation(poses.T_MH.R, "abb")
    lines = ["MODULE tomopose", f"  PROC {name}()"]
    for k, table in enumerate(_table_lines(poses, "    !")):
        x = poses.T_MH.t[k]
        position = ",".join(f"{v:.6f}" for v in x)
        orientation = ",".join(f"{v:.9f}" for v in q[k])
        lines += [
            *table,
            f"    ! pose_id {poses.pose_id[k]}",
            f"    MoveL [[{position}],[{orientation}],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]],v50,fine,tool0;",
            "    WaitTime 1.0;",
        ]
    return "\n".join([*lines, "  ENDPROC", "ENDMODULE"]) + "\n"


def ur_script(poses: PoseSequence, *, name: str = "tomopose_run") -> str:
    """Universal Robots script: movel in metres and rotation vectors (rad), in the base frame and the active TCP."""
    vectors = convention_from_rotation(poses.T_MH.R, "ur")
    lines = [f"def {name}():"]
    for k, table in enumerate(_table_lines(poses, "  #")):
        values = ", ".join(f"{v:.9f}" for v in (*(poses.T_MH.t[k] / 1000.0), *vectors[k]))
        lines += [
            *table,
            f"  # pose_id {poses.pose_id[k]}",
            f"  movel(p[{values}], a=0.1, v=0.02)",
            "  sleep(1.0)",
        ]
    return "\n".join([*lines, "end"]) + "\n"


WRITERS: MappingProxyType[str, Callable[[PoseSequence], str]] = MappingProxyType(
    {"pi-gcs": pi_gcs, "kuka-krl": kuka_krl, "abb-rapid": abb_rapid, "ur-script": ur_script}
)


def command_list(poses: PoseSequence, language: str) -> str:
    """The poses in one of the languages of WRITERS; ConventionError lists them."""
    try:
        writer = WRITERS[language]
    except KeyError:
        raise ConventionError(f"unknown command language {language!r}; known are {', '.join(WRITERS)}") from None
    return writer(poses)
