"""Staubli: VAL 3 data files (.dtx, XML).  x y z in mm, rx ry rz in deg about moved axes: R = R_x R_y R_z.

The pose is the tool's in the frame that fatherId names.  Source: Staubli, VAL 3 reference manual (trsf, pointRx;
Data elements with Value key, x, y, z, rx, ry, rz; an attribute that is absent is 0).
"""

from __future__ import annotations

import xml.etree.ElementTree as ET

from tomopose.errors import InputError
from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.kind import Kind
from tomopose.io.foreign.number_words import number_word
from tomopose.io.foreign.pose_log import PoseLog, PoseOptions, Row, numbered, one_value
from tomopose.io.foreign.xml_text import local_name, parse_xml

POINTS = ("pointRx", "pointRs", "point")
FRAME = ("x", "y", "z", "rx", "ry", "rz")


def recognise(file: ForeignFile) -> bool:
    """XML of VAL 3 with points."""
    return file.is_text and "staubli.com/robotics/VAL3" in file.text and '"point' in file.text


def read(file: ForeignFile, options: PoseOptions) -> PoseLog:
    """The points of a data file, in its order."""
    rows: list[Row] = []
    names: list[str] = []
    fathers: list[str] = []
    for data in parse_xml(file).iter():
        if local_name(data) != "Data" or data.get("type") not in POINTS:
            continue
        for value in data:
            name = f"{data.get('name')}[{value.get('key', '0')}]"
            if not any(a in value.attrib for a in FRAME):
                continue  # a point that nobody has taught
            rows.append(_row(value, f"{file.path}: {name}"))
            names.append(name)
            fathers.append(value.get("fatherId", "world[0]"))
    if not rows:
        raise InputError(f"{file.path}: no taught point (pointRx) is in the file")
    father = one_value(fathers, "the frame (fatherId)", file.path)
    return PoseLog(
        path=file.path,
        convention="staubli",
        rows=tuple(rows),
        source="set",
        pose_id=numbered(names),
        notes=(f"all poses are in frame {father}; frame and tool must stay as they are for the scan",),
    )


def _row(value: ET.Element, where: str) -> Row:
    return tuple(number_word(value.get(a, "0"), where) for a in FRAME)


KIND = Kind(name="staubli", maker="Staubli", what="a VAL 3 data file (.dtx)", recognise=recognise, read_poses=read)
