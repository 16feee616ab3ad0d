"""The export folder: manifest.json and the files of each format, whole or not at all."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from tomopose.errors import FileError, InputError, NotRepresentableError
from tomopose.exports.astra import to_astra
from tomopose.exports.cera import TABLE_NAME, to_cera
from tomopose.exports.cil import to_cil
from tomopose.exports.ctsimu import to_ctsimu
from tomopose.exports.leap import to_leap
from tomopose.exports.openct import to_openct
from tomopose.exports.panel import Rows, check_rows
from tomopose.exports.pyronn import to_pyronn
from tomopose.exports.robot_json import to_robot_json
from tomopose.exports.rtk import to_rtk
from tomopose.exports.rx_views import to_rx_views
from tomopose.exports.tigre import to_tigre
from tomopose.files import atomic_folder, plain, read_json, write_json
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.provenance import Provenance, provenance, sha256
from tomopose.values import require_types

MANIFEST = "manifest.json"
ABOUT = (
    "Geometry of one scan for several packages. World: mm, source at +x, z along the rotation axis at home. "
    "row0 says which detector row is row 0 of the arrays a format's numbers are made for: 'bottom' (array row index "
    "= v, v counts upwards as seen from the source) or 'top' (array row index = n_v - 1 - v). u is never flipped."
)


@dataclass(frozen=True, kw_only=True)
class Format:
    """How one format is written: `write(folder, matrices, rows)` gives its file names; the words go to the manifest.

    row0: "asked" where the numbers follow the caller's row order, else the only order the format has.
    """

    write: Callable[[Path, ProjectionMatrices, Rows], Sequence[str]]
    contents: str
    load: str
    row0: Literal["asked", "bottom", "files"] = "asked"
    rows_note: str = ""


def _npz(name: str, arrays: Mapping[str, object]) -> Callable[[Path], Sequence[str]]:
    def write(folder: Path) -> Sequence[str]:
        np.savez(folder / name, allow_pickle=False, **{k: np.asarray(v) for k, v in arrays.items()})
        return (name,)

    return write


def _json_text(content: Mapping[str, object]) -> str:
    return json.dumps(plain(content), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _text(folder: Path, files: Mapping[str, str]) -> Sequence[str]:
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8", newline="\n")
    return tuple(files)


def _write_astra(folder: Path, m: ProjectionMatrices, rows: Rows) -> Sequence[str]:
    np.save(folder / "astra.npy", to_astra(m, rows=rows))
    return ("astra.npy",)


def _write_rtk(folder: Path, m: ProjectionMatrices, rows: Rows) -> Sequence[str]:
    xml, side = to_rtk(m)
    return _text(folder, {"rtk.xml": xml, "rtk.json": _json_text(side)})


def _write_cera(folder: Path, m: ProjectionMatrices, rows: Rows) -> Sequence[str]:
    config, table = to_cera(m, image_rows=image_rows(m))
    return _text(folder, {"cera.config": config, TABLE_NAME: table})


def _write_thd(folder: Path, m: ProjectionMatrices, rows: Rows) -> Sequence[str]:
    (folder / "thd").mkdir()
    digits = len(str(len(m) - 1))
    views = {f"thd/view_{k:0{digits}d}.json": _json_text(view) for k, view in enumerate(to_robot_json(m))}
    return _text(folder, views)


def image_rows(matrices: ProjectionMatrices) -> Rows:
    """Row 0 of the scan's image *files*: the scanner's order where it is known, else "top", the order of TIFF."""
    scanner = matrices.scanner
    return "bottom" if scanner is not None and scanner.image_rows == "bottom-first" else "top"


_ONLY_BOTTOM = "the panel is placed by a rotation: give arrays with row 0 at the bottom (flip the image rows)"

FORMATS: Mapping[str, Format] = {
    "astra": Format(
        write=_write_astra,
        contents="(n, 12) float64: source, panel centre, column step, row step, mm",
        load="astra.create_proj_geom('cone_vec', rows, cols, numpy.load('astra.npy')); data are (rows, n, cols)",
    ),
    "rtk": Format(
        write=_write_rtk,
        contents="rtk.xml: geometry version 3; rtk.json: axes, origin and spacing of the projection stack, mm",
        load="rtk.ThreeDCircularProjectionGeometryXMLFileReader; give the stack origin and spacing of rtk.json",
        row0="bottom",
        rows_note=_ONLY_BOTTOM,
    ),
    "leap": Format(
        write=lambda folder, m, rows: _npz("leap.npz", to_leap(m, rows=rows))(folder),
        contents="source_positions, module_centers, row_vectors, col_vectors (n, 3), mm; pixel_height, pixel_width",
        load="leapct.set_modularbeam(n, rows, cols, pixel_height, pixel_width, sources, centers, row_v, col_v)",
    ),
    "tigre": Format(
        write=lambda folder, m, rows: _npz("tigre.npz", to_tigre(m))(folder),
        contents="fields of tigre.geometry, mm and rad, Python order [v, u]; angles are ZYZ",
        load="set the fields of tigre.geometry(mode='cone') and pass angles to tigre.Ax / tigre.algorithms",
        row0="bottom",
        rows_note=_ONLY_BOTTOM,
    ),
    "cil": Format(
        write=lambda folder, m, rows: _npz("cil.npz", to_cil(m, rows=rows))(folder),
        contents="source, detector, direction_x, direction_y (n, 3), mm; pixel_size, num_pixels [x, y]; origin",
        load="AcquisitionGeometry.create_Cone3D_Flex(source, detector, direction_x, direction_y).set_panel(...)",
    ),
    "cera": Format(
        write=_write_cera,
        contents=f"cera.config and the matrices of {TABLE_NAME}, which count v upwards",
        load="open cera.config; add volume and file names",
        row0="files",
        rows_note="row0 describes the image files (FlipV says the same); the matrices are the same for either order",
    ),
    "openct": Format(
        write=lambda folder, m, rows: _text(folder, {"openct.json": _json_text(to_openct(m))}),
        contents="FreeTrajectoryCBCTScan; the file names its detector frame: y down from the centre, mm",
        load="open openct.json as openCT JSON; add the image files and the bounding box",
        row0="bottom",
        rows_note="the file states its detector frame itself; converted to D the matrices count v upwards",
    ),
    "ctsimu": Format(
        write=lambda folder, m, rows: _text(folder, {"ctsimu.json": _json_text(to_ctsimu(m))}),
        contents="scenario, file format 1.2: source and panel do not move, the stage carries the poses",
        load="ctsimu.scenario.Scenario('ctsimu.json'); set_frame(i, reconstruction=True)",
        row0="bottom",
        rows_note="the matrices count v upwards; the format's image files have their top row first",
    ),
    "pyronn": Format(
        write=lambda folder, m, rows: _npz("pyronn.npz", to_pyronn(m, rows=rows))(folder),
        contents="projection_matrices (n, 3, 4), mm to px, |P[2, :3]| = 1, w > 0",
        load="geometry.set_trajectory(numpy.load('pyronn.npz')['projection_matrices']); also CONRAD",
    ),
    "thd": Format(
        write=_write_thd,
        contents="one JSON a view: focal spot, detector centre and quaternion (x, y, z, w) in W, mm; pitch and size",
        load="the robot-CT exchange format of THD Deggendorf",
        row0="files",
        rows_note="the detector's second axis points up the panel; image files have their top row first",
    ),
    "rx": Format(
        write=lambda folder, m, rows: _text(folder, {"geom.csv": to_rx_views(m)}),
        contents="source, panel centre and the middles of the panel's upper and right edges a view, in W, mm",
        load="geom.csv of RX Solutions; readers for CIL take it with the images' size",
        row0="files",
        rows_note="top and right lie on the outer edges of the panel; image files have their top row first",
    ),
}
"""The formats, in the order of the manifest."""


@dataclass(frozen=True, kw_only=True)
class Exported:
    """What was written.  folder; files by format; refused: format -> why it cannot hold this geometry."""

    folder: Path
    files: Mapping[str, tuple[str, ...]]
    refused: Mapping[str, str]
    provenance: Provenance


@require_types
def export(
    matrices: ProjectionMatrices,
    out: Path | str,
    *,
    formats: Sequence[str] | str = "all",
    rows: Rows = "bottom",
    force: bool = False,
) -> Exported:
    """Write the geometry for other packages: one folder with manifest.json and each format's files, all or none.

    Parameters
    ----------
    matrices: points of W (mm) to pixels of D.
    out:      the folder; made where absent, files of the same name replaced only with `force`.
    formats:  names out of astra, rtk, leap, tigre, cil, cera, openct, ctsimu, pyronn, thd, rx; or "all".
    rows:     row 0 of the arrays that go with the geometry: "bottom" (array row index = v) or "top".  rtk and tigre
              know only "bottom"; cera, openct and ctsimu state their own direction.  The manifest says it per format.

    Returns
    -------
    Exported.  With formats="all", formats that cannot hold the geometry are left out and named, with the reason, in
    `refused` and in the manifest.

    Raises
    ------
    NotRepresentableError(format, indices) where a format asked for by name cannot hold the geometry; InputError for an
    unknown format; FileError where the folder cannot be written.  Nothing is written then.
    """
    check_rows(rows)
    names = _named(formats)
    out = Path(out)
    files: dict[str, tuple[str, ...]] = {}
    entries: dict[str, Any] = {}
    refused: dict[str, str] = {}
    made = provenance(arguments={"formats": names, "rows": rows})
    with atomic_folder(out, force=force, stale=_files_of(out) if force else ()) as folder:
        for name in names:
            try:
                files[name] = tuple(FORMATS[name].write(folder, matrices, rows))
            except NotRepresentableError as error:
                if formats != "all":
                    raise
                refused[name] = str(error)
                continue
            entries[name] = _entry(FORMATS[name], folder, files[name], matrices, rows)
        write_json(folder / MANIFEST, "exports", _manifest(matrices, entries, refused, made))
    return Exported(folder=out, files=files, refused=refused, provenance=made)


def is_inside(name: str) -> bool:
    """Whether a name in a manifest is that of a file in the export's own folder."""
    path = Path(name)
    return not path.is_absolute() and ".." not in path.parts and bool(path.name)


def _files_of(out: Path) -> set[str]:
    """The files that an earlier export into this folder made; empty where its manifest cannot be read."""
    try:
        formats = read_json(out / MANIFEST, "exports").get("formats")
    except FileError:
        return set()
    entries = formats.values() if isinstance(formats, Mapping) else ()
    files = [e["files"] for e in entries if isinstance(e, Mapping) and isinstance(e.get("files"), Mapping)]
    return {str(name) for names in files for name in names if is_inside(str(name))}


def _named(formats: Sequence[str] | str) -> list[str]:
    if formats == "all":
        return list(FORMATS)
    names = [formats] if isinstance(formats, str) else list(dict.fromkeys(formats))
    unknown = [name for name in names if name not in FORMATS]
    if unknown or not names:
        found = f"unknown format {unknown[0]!r}" if unknown else "no format is named"
        raise InputError(f"{found}; known are {', '.join(FORMATS)}, or all")
    return names


def _entry(f: Format, folder: Path, files: Sequence[str], m: ProjectionMatrices, rows: Rows) -> dict[str, Any]:
    row0 = {"asked": rows, "bottom": "bottom", "files": image_rows(m)}[f.row0]
    note = {"row0_note": f.rows_note} if f.rows_note else {}
    sums = {name: sha256(folder / name) for name in files}
    return {"row0": row0, **note, "files": sums, "contents": f.contents, "load": f.load}


def _manifest(
    m: ProjectionMatrices, entries: Mapping[str, object], refused: Mapping[str, object], made: Provenance
) -> dict[str, Any]:
    return {
        "about": ABOUT,
        "n_views": len(m),
        "n_u_px": m.n_u,
        "n_v_px": m.n_v,
        "p_u_mm": m.p_u,
        "p_v_mm": m.p_v,
        "formats": entries,
        "refused": refused,
        "pose_id": list(m.pose_id),
        "provenance": made.to_json(),
    }
