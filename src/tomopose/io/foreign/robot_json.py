"""The robot-CT community's JSON: one view a file with focal spot, detector centre, orientation and pixel pitch, in
mm.
"""

from __future__ import annotations

from tomopose.errors import FileError
from tomopose.exports.robot_json import is_robot_json, panel_of
from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.kind import Kind
from tomopose.io.foreign.scanner_draft import ScannerDraft, sensible
from tomopose.reading import parse_json


def recognise(file: ForeignFile) -> bool:
    """The section projection_geometry with focal_spot_position_mm."""
    return file.is_text and "focal_spot_position_mm" in file.text and "detector_center_position_mm" in file.text


def read(file: ForeignFile) -> ScannerDraft:
    """Distance, pitch and size of the view's panel; the distance to the rotation axis is not in it."""
    content = parse_json(file.text, file.path)
    views = content if isinstance(content, list) else [content]
    if not views or not is_robot_json(views[0]):
        raise FileError(f"{file.path} holds no view of a robot scanner", path=file.path)
    panel = panel_of(views[0], str(file.path))
    return ScannerDraft(
        path=file.path,
        kind="a view of a robot scanner (JSON)",
        maker="THD Deggendorf",
        values=sensible(
            {
                "d_SD_mm": panel.d_SD,
                "p_u_mm": panel.p_u,
                "p_v_mm": panel.p_v,
                "n_u_px": float(panel.n_u),
                "n_v_px": float(panel.n_v),
                "u_0_px": panel.u_0,
                "v_0_px": panel.v_0,
            },
            str(file.path),
        ),
        notes=("source and detector move on robots: d_SD, u_0 and v_0 are those of this view",),
    )


KIND = Kind(
    name="thd",
    maker="THD Deggendorf",
    what="a view of a robot scanner (JSON)",
    recognise=recognise,
    read_scanner=read,
    holds_geometry=True,
)
