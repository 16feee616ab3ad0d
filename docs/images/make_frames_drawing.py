"""Draws docs/images/frames.svg and detector.svg.  Axes come from the package's own transforms; distances are shortened.

python docs/images/make_frames_drawing.py
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tomopose import Frame, RigidTransform, Scanner
from tomopose.files import write_text
from tomopose.geometry.rotations import R_x, R_y, R_z

FOLDER = Path(__file__).parent
INK, SOFT, PALE = "#1d2733", "#5b6775", "#c9d3dd"
AXES = ("#b2433f", "#2b7d4f", "#1f5f99")
FONT = 'font-family="Helvetica, Arial, DejaVu Sans, sans-serif"'
SCALE = 56.0
MIDDLE = np.array([405.0, 235.0])

# Seen from +y, a little from the source's side and from above: the source is left, the detector right.
AZIMUTH, ELEVATION = np.radians(64.0), np.radians(17.0)
TOWARDS_EYE = np.array([np.cos(AZIMUTH) * np.cos(ELEVATION), np.sin(AZIMUTH) * np.cos(ELEVATION), np.sin(ELEVATION)])
RIGHT = np.cross([0.0, 0.0, 1.0], TOWARDS_EYE) / np.cos(ELEVATION)
UP = np.cross(TOWARDS_EYE, RIGHT)


def place(x: object) -> np.ndarray:
    """Points (..., 3) of W on the paper."""
    x = np.asarray(x, dtype=np.float64)
    return MIDDLE + SCALE * np.stack([x @ RIGHT, -(x @ UP)], axis=-1)


def path(
    points: object,
    *,
    colour: str = SOFT,
    width: float = 1.4,
    fill: str = "none",
    dash: str = "",
    closed: bool = False,
    arrow: str = "",
) -> str:
    ends = "L".join(f"{a:.1f},{b:.1f}" for a, b in place(points))
    extra = f' stroke-dasharray="{dash}"' if dash else ""
    extra += f' marker-end="url(#{arrow})"' if arrow else ""
    return f'<path d="M{ends}{"Z" if closed else ""}" stroke="{colour}" stroke-width="{width}" fill="{fill}"{extra}/>'


def text(
    words: str,
    at: object,
    *,
    shift: tuple[float, float] = (0, 0),
    colour: str = INK,
    size: float = 15,
    anchor: str = "start",
    weight: str = "400",
) -> str:
    a, b = place(at) + np.asarray(shift)
    return (
        f'<text x="{a:.1f}" y="{b:.1f}" fill="{colour}" font-size="{size}" text-anchor="{anchor}" '
        f'font-weight="{weight}" {FONT}>{words}</text>'
    )


def triad(frame: RigidTransform, name: str, *, length: float = 1.05, label: tuple[float, float] = (-10, 20)) -> str:
    """A frame's axes, given as the transform from it to W."""
    parts = []
    for k, colour in enumerate(AXES):
        end = frame.t + length * frame.R[:, k]
        parts.append(path([frame.t, end], colour=colour, width=2.4, arrow=f"head{k}"))
        parts.append(text("xyz"[k], frame.t + 1.22 * length * frame.R[:, k], shift=(-4, 5), colour=colour, size=14))
    parts.append(text(name, frame.t, shift=label, size=19, weight="700"))
    return "".join(parts)


def disc(height: float, radius: float, **style: str) -> str:
    turn = np.linspace(0, 2 * np.pi, 90)
    return path(np.c_[radius * np.cos(turn), radius * np.sin(turn), np.full_like(turn, height)], closed=True, **style)


def frames_drawing() -> str:
    scanner = Scanner(d_SD=13.0, d_SR=5.2, p_u=0.1, p_v=0.1, u_0=24.5, v_0=19.5, n_u=50, n_v=40)
    T_SW = scanner.T_WS.inv
    U, V, O = scanner.panel
    corner = T_SW.apply(np.array([O, O + 49 * U, O + 49 * U + 39 * V, O + 39 * V]))
    world = RigidTransform.identity(Frame.W)
    table = scanner.T_TW(np.radians(28.0))
    H = RigidTransform(R=R_z(np.pi - 0.25), t=[-0.35, 0.0, -1.35], source=Frame.H, target=Frame.W)
    M = RigidTransform(R=H.R @ R_x(-0.1) @ R_y(0.28), t=[-1.25, 0.55, -0.2], source=Frame.M, target=Frame.W)
    ball = M.apply(np.array([0.1, -0.1, 0.75]))
    source = T_SW.t
    ray = source + (ball - source) * 13.0 / (source[0] - ball[0])
    turn = np.linspace(np.radians(-70), np.radians(-20), 20)
    parts = [
        path(corner, colour=INK, fill="#dfeaf4", closed=True, width=1.6),
        disc(-2.75, 1.9, colour=PALE, fill="#eef2f6"),
        disc(-2.5, 1.9, colour=SOFT, fill="#f7f9fb"),
        path([[0, 0, -3.1], [0, 0, 2.5]], colour=SOFT, dash="7 5"),
        text("table axis", [0, 0, 2.5], shift=(8, 8), colour=SOFT, size=13),
        path(np.c_[2.15 * np.cos(turn), 2.15 * np.sin(turn), np.full_like(turn, -2.6)], colour=SOFT, arrow="headS"),
        text("α", [2.15 * np.cos(turn[-1]), 2.15 * np.sin(turn[-1]), -2.6], shift=(-4, 20), colour=SOFT, size=16),
        *[path([source, c], colour="#d5b48f", width=1.0) for c in corner],
        path([source, [-7.8, 0, 0]], colour="#b98a4e", dash="5 4"),
        path([source, ray], colour="#d9792b", width=1.4),
    ]
    for k in range(3):  # legs, so that the plate is seen to be carried
        at = 2 * np.pi * k / 3 + 0.4
        foot = np.array([1.3 * np.cos(at), 1.3 * np.sin(at), -2.5])
        head = M.apply(np.array([0.7 * np.cos(at + 2.6), 0.7 * np.sin(at + 2.6), -0.45]))
        parts.append(path([foot, head], colour="#9aa6b3", width=4))
    plate = np.linspace(0, 2 * np.pi, 60)
    parts += [
        path(
            M.apply(np.c_[0.95 * np.cos(plate), 0.95 * np.sin(plate), np.full_like(plate, -0.45)]),
            colour=SOFT,
            fill="#eef2f6",
            closed=True,
        ),
        triad(world, "W", length=1.45, label=(-8, 24)),
        triad(table, "T", length=0.95, label=(22, 40)),
        triad(H, "H", length=0.85, label=(-28, 12)),
        triad(M, "M", length=0.8, label=(-4, 26)),
        triad(T_SW, "S", length=1.2, label=(-12, 26)),
        f'<circle cx="{place(source)[0]:.1f}" cy="{place(source)[1]:.1f}" r="5" fill="#d9792b"/>',
        f'<circle cx="{place(ball)[0]:.1f}" cy="{place(ball)[1]:.1f}" r="9" fill="#6b7683" stroke="{INK}"/>',
        f'<circle cx="{place([-7.8, 0, 0])[0]:.1f}" cy="{place([-7.8, 0, 0])[1]:.1f}" r="3" fill="#b98a4e"/>',
        text("ball, at t in M", ball, shift=(20, -10), colour=SOFT, size=13),
        f'<circle cx="{place(ray)[0]:.1f}" cy="{place(ray)[1]:.1f}" r="4" fill="#d9792b"/>',
        text("x<tspan dy='4' font-size='11'>D</tspan>", ray, shift=(10, 0), size=16),
        path([corner[0], corner[0] + 1.5 * (corner[1] - corner[0]) / 4.9], colour=AXES[0], width=2.4, arrow="head0"),
        path([corner[0], corner[0] + 1.5 * (corner[3] - corner[0]) / 3.9], colour=AXES[1], width=2.4, arrow="head1"),
        text("u", corner[0] + 1.75 * (corner[1] - corner[0]) / 4.9, shift=(-3, 14), colour=AXES[0]),
        text("v", corner[0] + 1.75 * (corner[3] - corner[0]) / 3.9, shift=(8, 4), colour=AXES[1]),
        text("D", corner[0], shift=(-8, 24), size=19, weight="700"),
        text(
            "(u<tspan dy='3' font-size='10'>0</tspan><tspan dy='-3'>, v</tspan><tspan dy='3' font-size='10'>0</tspan>"
            "<tspan dy='-3'>)</tspan>",
            [-7.8, 0, 0],
            shift=(6, 18),
            colour=SOFT,
            size=13,
        ),
        text("X-ray spot", source, shift=(-30, 46), colour=SOFT, size=13),
    ]
    for far, below, words in ((0.0, -3.7, "SR"), (-7.8, -4.4, "SD")):
        start, end = [5.2, 0, below], [far, 0, below]
        parts.append(path([start, end], colour=SOFT, width=1.1, arrow="headS"))
        middle = (np.array(start) + np.array(end)) / 2
        symbol = f"d<tspan dy='4' font-size='10'>{words}</tspan>"
        parts.append(text(symbol, middle, shift=(0, -6), colour=SOFT, size=15))
        parts += [path([[x, 0, -0.2], [x, 0, below - 0.15]], colour=PALE, width=1, dash="2 3") for x in (5.2, far)]
    title = "The six frames: source S, world W, table T, base H, plate M, detector D"
    return svg(parts, title, left=80, top=18, width=810, height=510)


def svg(parts: list[str], title: str, *, left: int = 0, top: int = 0, width: int, height: int) -> str:
    heads = "".join(
        f'<marker id="{name}" viewBox="0 0 10 10" refX="8" refY="5" markerWidth="6" markerHeight="6" '
        f'orient="auto-start-reverse"><path d="M0,0.6L10,5L0,9.4Z" fill="{colour}"/></marker>'
        for name, colour in (("head0", AXES[0]), ("head1", AXES[1]), ("head2", AXES[2]), ("headS", SOFT))
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{left} {top} {width} {height}" role="img">'
        f"<title>{title}</title><defs>{heads}</defs>"
        f'<rect x="{left}" y="{top}" width="{width}" height="{height}" fill="#ffffff"/>' + "\n".join(parts) + "</svg>\n"
    )


def detector_drawing() -> str:
    """Pixels of D beside the rows of an image file."""
    n_u, n_v, cell = 6, 4, 46.0
    parts = []

    def words(
        x: float, y: float, what: str, colour: str = INK, size: float = 14, weight: str = "400", anchor: str = "middle"
    ) -> None:
        parts.append(
            f'<text x="{x}" y="{y}" fill="{colour}" font-size="{size}" text-anchor="{anchor}" '
            f'font-weight="{weight}" {FONT}>{what}</text>'
        )

    for left, title, top_first in (
        (70.0, "frame D, seen from the source", False),
        (530.0, "image file (TIFF), rows top-first", True),
    ):
        words(left + n_u * cell / 2, 30, title, weight="700", size=15)
        for v in range(n_v):
            for u in range(n_u):
                x, y = left + u * cell, 50 + (n_v - 1 - v) * cell
                shade = "#fde5cd" if (u, v) == (0, 0) else "#dfeaf4" if (u, v) == (4, 2) else "#ffffff"
                parts.append(f'<rect x="{x}" y="{y}" width="{cell}" height="{cell}" fill="{shade}" stroke="{PALE}"/>')
                first = n_v - 1 - v if top_first else u
                second = u if top_first else v
                words(x + cell - 5, y + cell - 6, f"{first},{second}", SOFT, 11, anchor="end")
        bottom = 50 + n_v * cell
        x0, y0 = left + cell / 2, bottom - cell / 2
        if top_first:
            parts.append(
                f'<path d="M{left - 16},54V{bottom - 6}" stroke="{AXES[1]}" stroke-width="2.4" '
                'marker-end="url(#head1)"/>'
            )
            words(left - 30, 54 + n_v * cell / 2, "row r", AXES[1], anchor="end")
            words(left + n_u * cell / 2, bottom + 26, "numbers are r, column; v = n_v − 1 − r, u = column", SOFT, 13)
        else:
            parts.append(
                f'<path d="M{x0},{y0}H{x0 + 1.9 * cell}" stroke="{AXES[0]}" stroke-width="2.4" '
                'marker-end="url(#head0)"/>'
                f'<path d="M{x0},{y0}V{y0 - 1.9 * cell}" stroke="{AXES[1]}" stroke-width="2.4" '
                'marker-end="url(#head1)"/>'
                f'<circle cx="{x0}" cy="{y0}" r="3.5" fill="{INK}"/>'
            )
            words(x0 + 2.1 * cell, y0 - 4, "u", AXES[0])
            words(x0 - 17, y0 - 1.85 * cell, "v", AXES[1])
            words(left + n_u * cell / 2, bottom + 26, "numbers are u, v; (0, 0) is the centre of a pixel", SOFT, 13)
    return svg(parts, "Pixel coordinates of the frame D beside the rows of an image file", width=870, height=275)


if __name__ == "__main__":
    write_text(FOLDER / "frames.svg", frames_drawing())
    write_text(FOLDER / "detector.svg", detector_drawing())
