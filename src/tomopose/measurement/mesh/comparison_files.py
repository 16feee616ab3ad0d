"""A comparison as files: PLY and GLB with the colours of the `vik` map, VTP with the deviations, CSV, JSON."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from tomopose.files import atomic_folder, write_json, write_text
from tomopose.measurement.mesh.comparison import Comparison, table
from tomopose.units import MICROMETRES_PER_MM

FILES = ("comparison.ply", "comparison.glb", "comparison.vtp", "comparison.csv", "comparison.json")


def write_comparison(path: str | Path, comparison: Comparison, *, range_mm: float, force: bool = False) -> None:
    """All files of a comparison into the folder `path`, all or none; colours clipped at +-range_mm.

    Raises FileError where one exists and `force` is not given, EngineMissingError without cmcrameri.
    """
    colours = comparison.colours(range_mm)
    with atomic_folder(path, force=force) as temporary:
        (temporary / "comparison.ply").write_bytes(ply(comparison, colours))
        (temporary / "comparison.glb").write_bytes(glb(comparison, colours))
        write_text(temporary / "comparison.vtp", vtp(comparison))
        write_text(temporary / "comparison.csv", table(comparison))
        write_json(
            temporary / "comparison.json",
            "comparison",
            {**comparison.to_json(), "range_mm": range_mm, "share_within_range": comparison.share_within(range_mm)},
        )


def ply(comparison: Comparison, colours: np.ndarray) -> bytes:
    """Binary little-endian PLY: x, y, z (double, mm), colour, deviation_um."""
    n, m = len(comparison.points), len(comparison.mesh.faces)
    head = (
        f"ply\nformat binary_little_endian 1.0\ncomment unit mm, frame W\nelement vertex {n}\nproperty double x\n"
        "property double y\nproperty double z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n"
        f"property float deviation_um\nelement face {m}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    vertex = np.empty(n, dtype=[("x", "<f8", 3), ("c", "u1", 3), ("d", "<f4")])
    vertex["x"], vertex["c"], vertex["d"] = comparison.points, colours, comparison.deviation * MICROMETRES_PER_MM
    face = np.empty(m, dtype=[("n", "u1"), ("v", "<i4", 3)])
    face["n"], face["v"] = 3, comparison.mesh.faces
    return head.encode("ascii") + vertex.tobytes() + face.tobytes()


def glb(comparison: Comparison, colours: np.ndarray) -> bytes:
    """Binary glTF 2.0 with vertex colours, unlit; metres, as the format demands."""
    x = (comparison.points / 1000.0).astype("<f4")
    # Colours in glTF are linear; the map is sRGB (IEC 61966-2-1).
    s = colours / 255.0
    linear = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    c = np.column_stack([np.round(65535 * linear).astype("<u2"), np.full(len(x), 65535, dtype="<u2")])
    parts = [x.tobytes(), c.tobytes(), comparison.mesh.faces.astype("<u4").tobytes()]
    offsets = np.cumsum([0, *map(len, parts)]).tolist()
    views = [
        {"buffer": 0, "byteOffset": offsets[k], "byteLength": len(parts[k]), "target": t}
        for k, t in enumerate((34962, 34962, 34963))
    ]
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "tomopose"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "extensionsUsed": ["KHR_materials_unlit"],
        "materials": [{"pbrMetallicRoughness": {"metallicFactor": 0}, "extensions": {"KHR_materials_unlit": {}}}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}]}],
        "buffers": [{"byteLength": offsets[-1]}],
        "bufferViews": views,
        "accessors": [
            {
                "bufferView": 0,
                "componentType": 5126,
                "count": len(x),
                "type": "VEC3",
                "min": x.min(axis=0).tolist(),
                "max": x.max(axis=0).tolist(),
            },
            {"bufferView": 1, "componentType": 5123, "normalized": True, "count": len(x), "type": "VEC4"},
            {"bufferView": 2, "componentType": 5125, "count": comparison.mesh.faces.size, "type": "SCALAR"},
        ],
    }
    text = json.dumps(document, separators=(",", ":")).encode("utf-8")
    text += b" " * (-len(text) % 4)
    binary = b"".join(parts)
    binary += b"\0" * (-len(binary) % 4)
    total = 12 + 8 + len(text) + 8 + len(binary)
    return (
        b"glTF"
        + struct.pack("<II", 2, total)
        + struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", len(binary), b"BIN\0")
        + binary
    )


def vtp(comparison: Comparison) -> str:
    """VTK XML PolyData with the point array `deviation_um`; arrays inline, base64, each with its byte count before."""

    def block(values: np.ndarray) -> str:
        raw = values.tobytes()
        return base64.b64encode(struct.pack("<Q", len(raw)) + raw).decode("ascii")

    n, m = len(comparison.points), len(comparison.mesh.faces)
    deviation = (comparison.deviation * MICROMETRES_PER_MM).astype("<f8")
    return (
        '<?xml version="1.0"?>\n<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" '
        f'header_type="UInt64">\n<PolyData><Piece NumberOfPoints="{n}" NumberOfPolys="{m}">\n'
        '<PointData Scalars="deviation_um">'
        f'<DataArray type="Float64" Name="deviation_um" format="binary">{block(deviation)}</DataArray></PointData>\n'
        '<Points><DataArray type="Float64" NumberOfComponents="3" format="binary">'
        f"{block(np.ascontiguousarray(comparison.points, dtype='<f8'))}</DataArray></Points>\n"
        '<Polys><DataArray type="Int64" Name="connectivity" format="binary">'
        f"{block(comparison.mesh.faces.astype('<i8'))}</DataArray>"
        '<DataArray type="Int64" Name="offsets" format="binary">'
        f"{block(3 * np.arange(1, m + 1, dtype='<i8'))}</DataArray></Polys>\n"
        "</Piece></PolyData></VTKFile>\n"
    )
