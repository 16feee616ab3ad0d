"""poses.csv, written: poses in a named convention, floats with all their digits."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from tomopose.errors import UnitError
from tomopose.files import require_absent, write_text
from tomopose.geometry.rotations import Convention, convention_from_rotation, convention_named
from tomopose.geometry.transforms import RigidTransform
from tomopose.io import unit_checks
from tomopose.io.poses_csv import CONFIRMED, pose_columns
from tomopose.io.table_text import format_table
from tomopose.manipulator.poses import PoseSequence
from tomopose.values import require_types


@require_types
def write_poses(
    path: str | Path,
    poses: PoseSequence,
    *,
    convention: str | None = None,
    comments: Iterable[tuple[str, str]] = (),
    joint_units: Sequence[str] = (),
    force: bool = False,
) -> None:
    """Write poses.csv in a named convention (default: the one the poses came in), floats with all their digits.

    comments: further `# key: value` lines.  joint_units: "deg" or "mm" of each column of joint values; default "deg".
    FileError if the file exists and `force` is not given.
    """
    path = require_absent(path, force=force)
    c = convention_named(convention or poses.convention)
    columns: dict[str, Sequence[object]] = {"pose_id": poses.pose_id}
    columns |= _columns(poses.T_MH, c, commanded=False)
    if np.any(poses.alpha != 0):
        columns["alpha_deg"] = np.degrees(poses.alpha).tolist()
    if poses.image is not None:
        columns["image"] = poses.image
    if np.any(poses.ball_id != 0):
        columns["ball_id"] = poses.ball_id.tolist()
    if poses.time_utc is not None:
        columns["time_utc"] = poses.time_utc
    if poses.T_MH_set is not None:
        columns |= _columns(poses.T_MH_set, c, commanded=True)
    if poses.q is not None:
        units = tuple(joint_units) or ("deg",) * poses.q.shape[1]
        columns |= {
            f"q{k + 1}_{unit}": (np.degrees(q) if unit == "deg" else q).tolist()
            for k, (q, unit) in enumerate(zip(poses.q.T, units, strict=True))
        }
    head = {"convention": f"{c.name}, {CONFIRMED}" if poses.convention_confirmed else c.name, "source": poses.source}
    if poses.pivot is not None:
        head["pivot_mm"] = ", ".join(repr(float(x)) for x in poses.pivot)
    if _looks_doubtful(poses, c):
        head["units"] = "confirmed"
    write_text(path, format_table(head | dict(comments), columns))


def _columns(T_MH: RigidTransform, c: Convention, *, commanded: bool) -> dict[str, Sequence[object]]:
    values = np.hstack([T_MH.t, convention_from_rotation(T_MH.R, c.name)])
    return {name: values[:, k].tolist() for k, name in enumerate(pose_columns(c, commanded=commanded))}


def _looks_doubtful(poses: PoseSequence, c: Convention) -> bool:
    """Whether the reader would ask; the writer knows the answer."""
    try:
        for T in (poses.T_MH, poses.T_MH_set):
            if T is not None:
                unit_checks.require_millimetres(T.t, "", convention=c.name)
                if c.unit == "deg":
                    unit_checks.require_degrees(convention_from_rotation(T.R, c.name), "")
        unit_checks.require_table_degrees(np.degrees(poses.alpha), "")
    except UnitError:
        return True
    return False
