"""Residuals from every side: on the detector, by pose, by rotation, by coordinate, against the normal law."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.special import ndtri

from tomopose.calibration.result import Calibration
from tomopose.report.gather import MOST_DRAWN, Joined, evenly, minutes
from tomopose.report.page import Figure, Table
from tomopose.report.style import ACCENT, ALERT, LINE, ORANGE, ROTATION_COLOURS, SOFT, axis, layout
from tomopose.report.words import decimals, number
from tomopose.units import Array

ARROW_SHARE = 0.09
"""Length of the longest arrow, as a share of the plotted span."""


def _steps(value: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(s * power for s in (1.0, 2.0, 5.0) if s * power <= value * (1 + 1e-12)))


def quiver(calibration: Calibration, joined: Joined) -> Figure:
    """Residuals as arrows at the place where the ball was seen."""
    shown = joined.drawn
    x, r = shown.x_D, shown.r
    low, high = x.min(axis=0), x.max(axis=0)
    span = float(max((high - low).max(), 1.0))
    longest = float(joined.d.max(initial=0.0))
    scale = _steps(ARROW_SHARE * span / longest) if longest > 0 else 1.0
    tip = x + scale * r
    wing = 0.28 * scale
    turn = np.array([[0.9, 0.42], [-0.42, 0.9]])
    lines_u: list[float | None] = []
    lines_v: list[float | None] = []
    for base, end, arrow in zip(x, tip, r, strict=True):
        left, right = end - wing * turn @ arrow, end - wing * turn.T @ arrow
        for points in ((base, end), (left, end, right)):
            lines_u += [*(float(p[0]) for p in points), None]
            lines_v += [*(float(p[1]) for p in points), None]
    unit = _steps(max(longest, 1e-12))
    key_u, key_v = low[0] - 0.02 * span, low[1] - 0.17 * span
    data: list[dict[str, Any]] = [
        {
            "type": "scatter",
            "mode": "lines",
            "x": lines_u,
            "y": lines_v,
            "hoverinfo": "skip",
            "showlegend": False,
            "line": {"color": ACCENT, "width": 1.3},
        },
        {
            "type": "scatter",
            "mode": "markers",
            "x": x[:, 0],
            "y": x[:, 1],
            "showlegend": False,
            "marker": {"size": 4, "color": SOFT},
            "customdata": [[p, *row, d] for p, row, d in zip(shown.pose_id, r, shown.d, strict=True)],
            "hovertemplate": "pose %{customdata[0]}<br>u %{customdata[1]:.4~g} px, v %{customdata[2]:.4~g} px"
            "<br>length %{customdata[3]:.4~g} px<extra></extra>",
        },
        {
            "type": "scatter",
            "mode": "lines+text",
            "x": [key_u, key_u + scale * unit],
            "y": [key_v, key_v],
            "line": {"color": ALERT, "width": 2.5},
            "text": ["", f" {unit:g} px"],
            "textposition": "middle right",
            "showlegend": False,
            "hoverinfo": "skip",
            "textfont": {"color": ALERT},
        },
    ]
    return Figure(
        title="Residuals on the detector",
        meaning=f"Each arrow is observed minus calculated ball centre, drawn at {scale:g} times its length."
        + joined.drawn_words,
        look_for="Arrows of random direction are noise; a swirl, a common direction or growth towards one side is an "
        "error of the geometry (roll, tilt, distance) or of the manipulator.",
        data=data,
        layout=layout(
            xaxis=axis("u / px", constrain="domain"),
            yaxis=axis("v / px", scaleanchor="x", scaleratio=1, constrain="domain"),
            showlegend=False,
            margin={"l": 62, "r": 20, "t": 12, "b": 48},
        ),
        height=470,
        wide=False,
    )


def by_pose(joined: Joined) -> Figure:
    """d_k by pose, coloured by rotation: the paper's fig. 8."""
    data: list[dict[str, Any]] = []
    shown = joined.drawn
    groups = shown.group or ("used",) * len(shown.pose_id)
    for name in [*ROTATION_COLOURS, "used"]:
        rows = np.flatnonzero(np.array(groups) == name)
        if rows.size:
            data.append(
                {
                    "type": "scatter",
                    "mode": "markers",
                    "name": f"rotation {name}" if joined.group else "poses",
                    "x": shown.number[rows],
                    "y": shown.d[rows],
                    "text": [shown.pose_id[k] for k in rows],
                    "marker": {"size": 7, "color": ROTATION_COLOURS.get(name, ACCENT), "line": {"width": 0}},
                    "hovertemplate": "pose %{text}<br>d = %{y:.4~g} px<extra></extra>",
                }
            )
    rms = float(np.sqrt(np.mean(joined.d**2)))
    ends = [float(joined.number.min()), float(joined.number.max())]
    data.append(
        {
            "type": "scatter",
            "mode": "lines",
            "x": ends,
            "y": [rms, rms],
            "name": f"d_rms = {number(rms)} px",
            "line": {"color": SOFT, "width": 1.3, "dash": "dash"},
            "hoverinfo": "skip",
        }
    )
    return Figure(
        title="Reprojection error by pose (paper, fig. 8)",
        meaning="d_k of eq. (8): the distance between detected and calculated ball centre for each pose, coloured by "
        "the axis of the manipulator's rotation." + joined.drawn_words,
        look_for="One colour far above the others is a rotation which the manipulator does not perform as it "
        "reports; single points far above are bad images.",
        data=data,
        layout=layout(xaxis=axis("pose number"), yaxis=axis("d / px", rangemode="tozero")),
        height=390,
    )


def over_sequence(joined: Joined) -> Figure:
    """Both components of the residual in the order of acquisition, with a running median."""
    data: list[dict[str, Any]] = []
    shown = joined.drawn
    order = np.argsort(joined.number, kind="stable")
    some = evenly(len(order), MOST_DRAWN)
    width = max(5, 2 * (len(order) // 24) + 1)
    for k, (name, colour) in enumerate((("u", ACCENT), ("v", ORANGE))):
        values = joined.r[order, k]
        data.append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": name,
                "x": shown.number,
                "y": shown.r[:, k],
                "marker": {"size": 4.5, "color": colour, "opacity": 0.55},
                "text": shown.pose_id,
                "hovertemplate": f"pose %{{text}}<br>{name} %{{y:.4~g}} px<extra></extra>",
            }
        )
        if len(order) > width:
            data.append(
                {
                    "type": "scatter",
                    "mode": "lines",
                    "name": f"{name}, running median",
                    "x": joined.number[order][some],
                    "y": _running_median(values, width)[some],
                    "hoverinfo": "skip",
                    "line": {"color": colour, "width": 2},
                }
            )
    return Figure(
        title="Residuals in the order of acquisition",
        meaning="Residuals in u and v by pose, with a running median of all." + joined.drawn_words,
        look_for="A slope is drift (temperature, focal spot); a step is a bump, a ball that slipped or a machine that "
        "was referenced anew.",
        data=data,
        layout=layout(xaxis=axis("pose number"), yaxis=axis("residual / px")),
        height=330,
    )


def _running_median(values: Array, width: int) -> Array:
    half = width // 2
    padded = np.pad(values, half, mode="edge")
    return np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1), axis=1)


def by_coordinate(joined: Joined) -> Figure | None:
    """Residuals against every coordinate of the pose, the table angle and time; None without poses."""
    shown = joined.drawn
    poses = shown.poses
    if poses is None:
        return None
    angles = np.degrees(poses.T_MH.angles)
    columns: list[tuple[str, Array]] = [(f"{n} / mm", poses.T_MH.t[:, k]) for k, n in enumerate("xyz")]
    columns += [(f"φ_{n} / °", angles[:, k]) for k, n in enumerate("xyz")]
    columns.append(("table α / °", np.degrees(poses.alpha)))
    time = minutes(poses.time_utc)
    columns.append(
        ("time / min", time) if time is not None else ("distance from pivot / mm", np.linalg.norm(poses.T_MH.t, axis=1))
    )
    data: list[dict[str, Any]] = []
    extra: dict[str, Any] = {}
    limit = 1.1 * float(np.abs(joined.r).max(initial=0.0)) or 1.0
    for panel, (title, x) in enumerate(columns):
        suffix = "" if panel == 0 else str(panel + 1)
        row, column = divmod(panel, 4)
        left, bottom = column * 0.255, (1 - row) * 0.56
        extra[f"xaxis{suffix}"] = axis(title, domain=[left, left + 0.225], anchor=f"y{suffix}", nticks=5)
        extra[f"yaxis{suffix}"] = axis(
            "residual / px" if column == 0 else "",
            domain=[bottom, bottom + 0.42],
            anchor=f"x{suffix}",
            range=[-limit, limit],
            nticks=5,
            showticklabels=column == 0,
        )
        for k, (name, colour) in enumerate((("u", ACCENT), ("v", ORANGE))):
            data.append(
                {
                    "type": "scatter",
                    "mode": "markers",
                    "name": name,
                    "x": x,
                    "y": shown.r[:, k],
                    "xaxis": f"x{suffix}",
                    "yaxis": f"y{suffix}",
                    "legendgroup": name,
                    "showlegend": panel == 0,
                    "marker": {"size": 4, "color": colour, "opacity": 0.55},
                    "text": shown.pose_id,
                    "hovertemplate": f"pose %{{text}}<br>{name} %{{y:.4~g}} px<extra></extra>",
                }
            )
    return Figure(
        title="Residuals against each coordinate of the pose",
        meaning="The same residuals against position and angles of the manipulator, table angle and time."
        + joined.drawn_words,
        look_for="A slope against a position is a scale or axis error, a slope against an angle a wrong rotation axis, "
        "two branches at one value are backlash.",
        data=data,
        layout=layout(**extra),
        height=470,
    )


def rotation_table(calibration: Calibration, joined: Joined) -> Table | None:
    """rms of d_k by rotation, in pixels and at the object; None without poses."""
    if joined.group is None:
        return None
    to_um = np.sqrt(calibration.scanner.p_u * calibration.scanner.p_v) / calibration.scanner.magnification * 1000.0
    groups = np.array(joined.group)
    rows = []
    k_px, k_um = decimals(joined.d), decimals(joined.d * to_um)
    for name in [g for g in ROTATION_COLOURS if (groups == g).any()]:
        k = groups == name
        rms = float(np.sqrt(np.mean(joined.d[k] ** 2)))
        mean = joined.r[k].mean(axis=0)
        rows.append(
            [
                name,
                int(k.sum()),
                f"{rms:.{k_px}f}",
                f"{rms * to_um:.{k_um}f}",
                f"{joined.d[k].max():.{k_px}f}",
                f"{mean[0]:+.{k_px}f}",
                f"{mean[1]:+.{k_px}f}",
            ]
        )
    return Table(
        title="Residuals by rotation axis",
        meaning="The paper's question of sec. 5.2: which rotations carry the error?",
        columns=["rotation", "poses", "d_rms / px", "at object / µm", "largest", "mean u", "mean v"],
        rows=rows,
        numeric=range(1, 7),
        wide=False,
    )


def histogram(joined: Joined) -> Figure:
    """Normalised residuals with the normal density."""
    z = joined.z.ravel()
    edge = max(4.0, float(np.ceil(np.abs(z).max(initial=0.0))))
    bins = int(np.clip(2 * np.ceil(np.sqrt(z.size)), 12, 60))
    counts, edges = np.histogram(z, bins=bins, range=(-edge, edge), density=True)
    x = np.linspace(-edge, edge, 161)
    by = "their predicted standard uncertainty" if joined.predicted else "their own rms (no predicted one was given)"
    return Figure(
        title="Normalised residuals",
        meaning=f"Residuals in u and v divided by {by}; the line is the normal law.",
        look_for="A histogram wider than the line means that the residuals hold more than detection noise.",
        data=[
            {
                "type": "bar",
                "x": (edges[1:] + edges[:-1]) / 2,
                "y": counts,
                "width": edges[1] - edges[0],
                "marker": {"color": "#9dbfdd", "line": {"color": "#ffffff", "width": 0.6}},
                "name": "residuals",
                "hovertemplate": "%{x:.2f}: %{y:.3f}<extra></extra>",
            },
            {
                "type": "scatter",
                "mode": "lines",
                "x": x,
                "y": np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi),
                "line": {"color": ALERT, "width": 2},
                "name": "normal law",
                "hoverinfo": "skip",
            },
        ],
        layout=layout(xaxis=axis("residual / σ"), yaxis=axis("density"), bargap=0),
        height=340,
        wide=False,
    )


def quantiles(joined: Joined) -> Figure:
    """Q-Q plot of the normalised residuals."""
    z = np.sort(joined.z.ravel())
    q = ndtri((np.arange(1, z.size + 1) - 0.5) / z.size)
    end = 1.1 * float(max(np.abs(q).max(initial=1.0), 1.0))
    # the ends are what is looked at: evenly in the quantile, not in the rank
    places = np.linspace(q[0], q[-1], MOST_DRAWN)
    some = np.unique(np.searchsorted(q, places)) if z.size > 2 * MOST_DRAWN else np.arange(z.size)
    return Figure(
        title="Quantiles against the normal law",
        meaning="Sorted normalised residuals against the quantiles of the normal law.",
        look_for="Points on the line: the stated noise explains the residuals; a steeper line: noise understated; bent "
        "ends: outliers.",
        data=[
            {
                "type": "scatter",
                "mode": "lines",
                "x": [-end, end],
                "y": [-end, end],
                "hoverinfo": "skip",
                "line": {"color": LINE, "width": 2},
                "showlegend": False,
            },
            {
                "type": "scatter",
                "mode": "markers",
                "x": q[some],
                "y": z[some],
                "marker": {"size": 4.5, "color": ACCENT},
                "hovertemplate": "expected %{x:.2f}, found %{y:.2f}<extra></extra>",
                "showlegend": False,
            },
        ],
        layout=layout(xaxis=axis("expected / σ"), yaxis=axis("found / σ"), showlegend=False),
        height=340,
        wide=False,
    )
