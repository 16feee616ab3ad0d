"""Three-dimensional scenes: the whole scanner, the ball's places around the manipulator's frame, the source's path."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tomopose.calibration.result import Calibration
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.report.gather import Joined
from tomopose.report.page import Figure
from tomopose.report.style import ACCENT, ALERT, ORANGE, SEQUENTIAL, SOFT, colour_bar, layout, space_axis
from tomopose.units import Array

AXIS_COLOURS = ("#b2433f", "#2b7d4f", "#1f5f99")
CAMERA = {"eye": {"x": 1.1, "y": -1.9, "z": 0.9}, "center": {"x": 0, "y": 0, "z": -0.12}}
NEAR_CAMERA = {"eye": {"x": 0.3, "y": -1.55, "z": 0.55}, "center": {"x": 0, "y": 0, "z": -0.04}}


def _line(points: ArrayLike, colour: str, name: str = "", *, width: float = 3, dash: str = "solid") -> dict[str, Any]:
    x = np.asarray(points, dtype=np.float64)
    return {
        "type": "scatter3d",
        "mode": "lines",
        "x": x[:, 0],
        "y": x[:, 1],
        "z": x[:, 2],
        "name": name,
        "showlegend": bool(name),
        "hoverinfo": "skip",
        "line": {"color": colour, "width": width, "dash": dash},
    }


def _points(points: ArrayLike, name: str, **marker: object) -> dict[str, Any]:
    x = np.atleast_2d(np.asarray(points, dtype=np.float64))
    return {
        "type": "scatter3d",
        "mode": "markers",
        "x": x[:, 0],
        "y": x[:, 1],
        "z": x[:, 2],
        "name": name,
        "marker": marker,
        "hovertemplate": f"{name}<br>%{{x:.3f}}, %{{y:.3f}}, %{{z:.3f}} mm<extra></extra>",
    }


def _triad(frame: RigidTransform, length: float, name: str) -> list[dict[str, Any]]:
    """Axes of a frame, red green blue for x y z, with a letter at each end."""
    traces = []
    for k, colour in enumerate(AXIS_COLOURS):
        end = frame.t + length * frame.R[:, k]
        trace = _line([frame.t, end], colour, width=6)
        letter = f"{'xyz'[k]}<sub>{name}</sub>"
        trace.update(mode="lines+text", text=["", letter], textfont={"color": colour, "size": 13})
        traces.append(trace)
    return traces


def _scene(**changes: object) -> dict[str, Any]:
    scene = {
        "xaxis": space_axis("x / mm"),
        "yaxis": space_axis("y / mm"),
        "zaxis": space_axis("z / mm"),
        "aspectmode": "data",
        "camera": CAMERA,
        "dragmode": "turntable",
        **changes,
    }
    return layout(scene=scene, margin={"l": 0, "r": 0, "t": 30, "b": 0})


def panel_corners(scanner: Scanner) -> Array:
    """The four outer corners of the detector in W, mm, (5, 3), closed."""
    U, V, O = scanner.panel
    u, v = scanner.n_u - 0.5, scanner.n_v - 0.5
    corners = [O + a * U + b * V for a, b in ((-0.5, -0.5), (u, -0.5), (u, v), (-0.5, v), (-0.5, -0.5))]
    return scanner.T_WS.inv.apply(np.array(corners))


def manipulator_in_world(calibration: Calibration) -> RigidTransform:
    """T_HW at table angle 0."""
    return calibration.scanner.T_TW(0.0) @ calibration.T_HT


def ball_in_world(calibration: Calibration, joined: Joined) -> Array | None:
    """Ball centres (n, 3) in W, mm, of the poses used; None without poses."""
    poses = joined.poses
    if poses is None:
        return None
    t = np.array([calibration.balls.get(int(b), calibration.t) for b in poses.ball_id])
    x_T = calibration.T_HT.apply((poses.T_MH.R @ t[:, :, None])[..., 0] + poses.T_MH.t)
    T_TW = calibration.scanner.T_TW(poses.alpha)
    return (T_TW.R @ x_T[:, :, None])[..., 0] + T_TW.t


def scanner_scene(calibration: Calibration, joined: Joined) -> Figure:
    """Source, beam, detector, table axis, manipulator frame and ball, to scale."""
    scanner = calibration.scanner
    corners = panel_corners(scanner)
    source = scanner.T_WS.inv.t
    reach = 0.3 * scanner.d_SR
    axis_line = scanner.table_axis.apply(np.array([[0, 0, -reach], [0, 0, reach]]))
    data = [
        _points(source, "source", size=5, color=ORANGE),
        {
            "type": "mesh3d",
            "x": corners[:4, 0],
            "y": corners[:4, 1],
            "z": corners[:4, 2],
            "i": [0, 0],
            "j": [1, 2],
            "k": [2, 3],
            "color": "#9dbfdd",
            "opacity": 0.45,
            "name": "detector",
            "showlegend": True,
            "hoverinfo": "skip",
        },
        _line(corners, ACCENT, width=3),
        *[_line([source, corner], "#d5b48f", width=1.5) for corner in corners[:4]],
        _line(axis_line, SOFT, "table axis", width=4, dash="dash"),
        *_triad(manipulator_in_world(calibration), 0.16 * scanner.d_SD / 2, "H"),
    ]
    ball = ball_in_world(calibration, joined.drawn)
    if ball is not None:
        data.append(_points(ball, "ball positions", size=2.5, color=ALERT))
    return Figure(
        title="The scanner, to scale",
        meaning="Source, beam, detector, table axis and the manipulator's frame H in the world frame W, as calibrated.",
        look_for="The manipulator's axes should point as it is mounted, and the ball should lie in the beam.",
        data=data,
        layout=_scene(camera=NEAR_CAMERA, yaxis=space_axis("y / mm", nticks=3), zaxis=space_axis("z / mm", nticks=4)),
        height=430,
    )


def ball_scene(calibration: Calibration, joined: Joined) -> Figure | None:
    """The ball's places in W, coloured by the residual; None without poses."""
    shown = joined.drawn
    ball = ball_in_world(calibration, shown)
    if ball is None:
        return None
    frame = manipulator_in_world(calibration)
    span = float(max(np.ptp(np.vstack([ball, frame.t[None]]), axis=0).max(), 1.0))
    dots = _points(
        ball,
        "ball",
        size=4.5,
        color=shown.d,
        colorscale=SEQUENTIAL,
        showscale=True,
        colorbar=colour_bar("d / px", len=0.7),
    )
    dots["text"] = shown.pose_id
    dots["hovertemplate"] = (
        "pose %{text}<br>%{x:.2f}, %{y:.2f}, %{z:.2f} mm<br>d = %{marker.color:.4~g} px<extra></extra>"
    )
    return Figure(
        title="Where the ball was",
        meaning="Ball centres of all poses in W and the manipulator's frame H; colour is the reprojection error."
        + joined.drawn_words,
        look_for="The cloud should fill the volume that the scan will use; a coloured side points at a place-dependent "
        "error.",
        data=[dots, *_triad(frame, 0.35 * span, "H")],
        layout={**_scene(), "showlegend": False},
        height=460,
        wide=False,
    )


def source_path(scan: ProjectionMatrices) -> Figure:
    """The scan as the object sees it: the source travels around it (paper, fig. 9)."""
    view = scan.decompose()
    source = view.source
    radius = float(np.median(np.hypot(source[:, 0], source[:, 1])))
    turn = np.linspace(0, 2 * np.pi, 181)
    circle = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), np.zeros_like(turn)])
    path = _points(
        source,
        "source",
        size=3,
        color=np.arange(1, len(source) + 1),
        colorscale=SEQUENTIAL,
        showscale=True,
        colorbar=colour_bar("view", len=0.7),
    )
    path.update(mode="lines+markers", line={"color": "#b9c6d3", "width": 2})
    return Figure(
        title="Path of the source as the object sees it (paper, fig. 9)",
        meaning="Source positions of the scan in the object's frame (W at home), beside an ordinary scan's circle.",
        look_for="The path should be smooth; jumps are missing or exchanged poses.",
        data=[
            path,
            _line(circle, ALERT, "circular scan", width=3),
            *_triad(RigidTransform.identity(Frame.W), 0.3 * radius, "W"),
        ],
        layout=_scene(aspectmode="manual", aspectratio={"x": 1.25, "y": 1.25, "z": 0.75}),
        height=460,
        wide=False,
    )
