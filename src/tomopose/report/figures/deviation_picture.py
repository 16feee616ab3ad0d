"""Deviations of a surface as a picture: the reference mesh drawn by a depth buffer, in the colours of the `vik` map.

No graphics driver is needed, and the same numbers give the same picture.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tomopose.errors import ShapeError
from tomopose.kernel_cache import njit
from tomopose.measurement.mesh.colours import vik
from tomopose.report.figures.png import colour_png, data_uri
from tomopose.report.page import Figure
from tomopose.report.style import axis, colour_bar, layout
from tomopose.units import Array

FINER = 2
"""Each pixel is averaged over FINER x FINER."""
NOT_MEASURED = (150, 150, 150)
LIGHT = np.array([-0.35, 0.45, 0.82])
"""Direction to the light: right, up, towards the viewer."""
AMBIENT = 0.5
FILL_ROUNDS = 3
SPECK_MM = 0.01


def vik_scale(steps: int = 33) -> list[list[Any]]:
    """The `vik` map (Crameri 2018) as plotly's pairs of place and colour; EngineMissingError without cmcrameri."""
    s = np.linspace(0, 1, steps)
    return [[float(a), f"rgb({r},{g},{b})"] for a, (r, g, b) in zip(s, vik(s).tolist(), strict=True)]


def viewpoint(azimuth_deg: float, elevation_deg: float) -> Array:
    """(3, 3), rows right, up and towards a viewer who is at that azimuth and elevation; z points up."""
    a, e = np.radians([azimuth_deg, elevation_deg])
    towards = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    return np.stack([right, np.cross(towards, right), towards])


def neighbours_filled(values: Array, faces: np.ndarray) -> Array:
    """Values (n,) with nan replaced by the mean of the neighbours that have one; sharp edges are drawn so."""
    out = np.array(values, dtype=np.float64)
    for _ in range(FILL_ROUNDS):
        known = np.isfinite(out)
        if known.all():
            break
        total, count = np.zeros(len(out)), np.zeros(len(out))
        for k in range(3):
            for j in (1, 2):
                other = faces[:, (k + j) % 3]
                np.add.at(total, faces[:, k], np.where(known[other], out[other], 0.0))
                np.add.at(count, faces[:, k], known[other])
        out = np.where(known | (count == 0), out, total / np.maximum(count, 1))
    return out


@njit(cache=True)
def _depth_buffer(
    x: np.ndarray,
    faces: np.ndarray,
    values: np.ndarray,
    shade: np.ndarray,
    depth: np.ndarray,
    value: np.ndarray,
    light: np.ndarray,
) -> None:
    n_v, n_u = depth.shape
    for f in range(len(faces)):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        area = (x[j, 0] - x[i, 0]) * (x[k, 1] - x[i, 1]) - (x[j, 1] - x[i, 1]) * (x[k, 0] - x[i, 0])
        if area <= 0.0:
            continue
        u_0, u_1 = min(x[i, 0], x[j, 0], x[k, 0]), max(x[i, 0], x[j, 0], x[k, 0])
        v_0, v_1 = min(x[i, 1], x[j, 1], x[k, 1]), max(x[i, 1], x[j, 1], x[k, 1])
        u_0, u_1 = min(max(u_0, 0.0), float(n_u)), min(max(u_1, -1.0), n_u - 1.0)
        v_0, v_1 = min(max(v_0, 0.0), float(n_v)), min(max(v_1, -1.0), n_v - 1.0)
        for v in range(int(np.ceil(v_0)), int(np.floor(v_1)) + 1):
            for u in range(int(np.ceil(u_0)), int(np.floor(u_1)) + 1):
                a = ((x[j, 0] - u) * (x[k, 1] - v) - (x[j, 1] - v) * (x[k, 0] - u)) / area
                b = ((x[k, 0] - u) * (x[i, 1] - v) - (x[k, 1] - v) * (x[i, 0] - u)) / area
                c = 1.0 - a - b
                if a < -1e-9 or b < -1e-9 or c < -1e-9:
                    continue
                z = a * x[i, 2] + b * x[j, 2] + c * x[k, 2]
                if z > depth[v, u]:
                    depth[v, u] = z
                    value[v, u] = a * values[i] + b * values[j] + c * values[k]
                    light[v, u] = a * shade[i] + b * shade[j] + c * shade[k]


def drawn(
    points: Array,
    faces: np.ndarray,
    normals: Array,
    values: Array,
    *,
    range_um: float,
    R: Array,
    px_per_mm: float,
    size_mm: tuple[float, float],
) -> np.ndarray:
    """(height, width, 3) uint8: a mesh, points and normals (n, 3), coloured by values (n,), um, clipped at +-range_um.

    R: as of `viewpoint`;  size_mm: (width, height) of the picture, whose middle shows the origin.
    """
    if values.shape != (len(points),) or normals.shape != points.shape:
        raise ShapeError(f"{len(points)} points have {values.shape} values and {normals.shape} normals")
    scale = FINER * px_per_mm
    n_u, n_v = (FINER * int(np.ceil(px_per_mm * s)) for s in size_mm)
    x = scale * (points @ R.T) + np.array([n_u / 2, n_v / 2, 0.0])
    shade = AMBIENT + (1 - AMBIENT) * np.maximum(normals @ R.T @ (LIGHT / np.linalg.norm(LIGHT)), 0.0)
    depth = np.full((n_v, n_u), -np.inf)
    value, light = np.full((n_v, n_u), np.nan), np.ones((n_v, n_u))
    _depth_buffer(x, np.asarray(faces, dtype=np.int64), values, shade, depth, value, light)
    colour = vik(np.clip(0.5 + 0.5 * np.nan_to_num(value) / range_um, 0, 1)).astype(np.float64)
    colour[~np.isfinite(value)] = NOT_MEASURED
    colour *= light[..., None]
    colour[~np.isfinite(depth)] = 255.0
    smooth = colour.reshape(n_v // FINER, FINER, n_u // FINER, FINER, 3).mean(axis=(1, 3))
    return np.asarray(np.round(smooth[::-1]), dtype=np.uint8)


def deviation_figure(
    panels: Mapping[str, Array],
    points: Array,
    faces: np.ndarray,
    normals: Array,
    *,
    range_um: float,
    title: str,
    meaning: str,
    look_for: str,
    azimuth_deg: float = -60.0,
    elevation_deg: float = 20.0,
    px_per_mm: float = 8.0,
) -> Figure:
    """One picture of the mesh for each name -> deviations (n,), um, side by side on one colour scale."""
    R = viewpoint(azimuth_deg, elevation_deg)
    seen = points @ R.T
    width, height = 2.06 * np.abs(seen[:, 0]).max(), 2.06 * np.abs(seen[:, 1]).max()
    images, words = [], []
    for k, (name, values) in enumerate(panels.items()):
        picture = drawn(
            points,
            faces,
            normals,
            neighbours_filled(values, faces),
            range_um=range_um,
            R=R,
            px_per_mm=px_per_mm,
            size_mm=(width, height),
        )
        images.append(
            {
                "source": data_uri(colour_png(picture)),
                "xref": "x",
                "yref": "y",
                "x": k * width,
                "y": height,
                "sizex": width,
                "sizey": height,
                "sizing": "stretch",
                "layer": "below",
            }
        )
        words.append({"x": (k + 0.5) * width, "y": height, "text": name, "showarrow": False, "yanchor": "bottom"})
    bare: dict[str, Any] = {"visible": False, "showgrid": False, "zeroline": False}
    # A speck in the corner carries the colour bar.
    scale = {
        "type": "heatmap",
        "x": [0, SPECK_MM],
        "y": [0, SPECK_MM],
        "z": [[0, 0], [0, 0]],
        "zmin": -range_um,
        "zmax": range_um,
        "colorscale": vik_scale(),
        "colorbar": colour_bar("deviation / µm"),
    }
    return Figure(
        title=title,
        meaning=meaning,
        look_for=look_for,
        data=[scale],
        height=620,
        layout=layout(
            images=images,
            annotations=words,
            xaxis=axis(range=[0, len(panels) * width], constrain="domain", **bare),
            yaxis=axis(range=[0, 1.1 * height], scaleanchor="x", constrain="domain", **bare),
        ),
    )
