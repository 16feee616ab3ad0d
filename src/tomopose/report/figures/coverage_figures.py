"""What the poses cover, and what they can determine: detector, rotations, table angles, correlations, singular
values."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tomopose.calibration.result import Calibration
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.observations import BallObservations
from tomopose.report.gather import MOST_DRAWN, Joined, evenly
from tomopose.report.page import Figure
from tomopose.report.style import (
    ACCENT,
    ALERT,
    DIVERGING,
    LINE,
    ORANGE,
    ROTATION_COLOURS,
    SOFT,
    axis,
    colour_bar,
    layout,
)
from tomopose.report.words import symbol
from tomopose.units import Array


def detector_map(calibration: Calibration, joined: Joined, observations: BallObservations | None) -> Figure:
    """Where on the panel the ball was seen."""
    scanner, shown = calibration.scanner, joined.drawn
    u, v = scanner.n_u - 0.5, scanner.n_v - 0.5
    data: list[dict[str, Any]] = [
        {
            "type": "scatter",
            "mode": "lines",
            "x": [-0.5, u, u, -0.5, -0.5],
            "y": [-0.5, -0.5, v, v, -0.5],
            "line": {"color": SOFT, "width": 1.5},
            "hoverinfo": "skip",
            "showlegend": False,
        },
        {
            "type": "scatter",
            "mode": "markers",
            "x": shown.x_D[:, 0],
            "y": shown.x_D[:, 1],
            "name": "used",
            "marker": {"size": 5.5, "color": ACCENT},
            "text": shown.pose_id,
            "hovertemplate": "pose %{text}<br>%{x:.1f}, %{y:.1f} px<extra></extra>",
        },
    ]
    if observations is not None:
        used = set(joined.pose_id)
        rest = [
            k for k, p in enumerate(observations.pose_id) if p not in used and np.isfinite(observations.x_D[k]).all()
        ]
        rest = [rest[k] for k in evenly(len(rest), MOST_DRAWN)]
        if rest:
            data.append(
                {
                    "type": "scatter",
                    "mode": "markers",
                    "name": "set aside",
                    "x": observations.x_D[rest, 0],
                    "y": observations.x_D[rest, 1],
                    "text": [observations.pose_id[k] for k in rest],
                    "marker": {"size": 8, "symbol": "x-thin", "line": {"width": 2, "color": ALERT}},
                    "hovertemplate": "pose %{text}<br>%{x:.1f}, %{y:.1f} px<extra></extra>",
                }
            )
    data.append(
        {
            "type": "scatter",
            "mode": "markers",
            "x": [scanner.u_0],
            "y": [scanner.v_0],
            "name": "piercing point",
            "marker": {"size": 12, "symbol": "cross-thin", "line": {"width": 2, "color": ORANGE}},
            "hovertemplate": "piercing point<br>%{x:.2f}, %{y:.2f} px<extra></extra>",
        }
    )
    return Figure(
        title="Coverage of the detector",
        meaning="Where the ball was seen on the panel; the frame is its edge." + joined.drawn_words,
        look_for="The projections should reach as far out as the object of the scan will; the model is not tested "
        "where there are no points.",
        data=data,
        layout=layout(
            xaxis=axis("u / px", constrain="domain"),
            yaxis=axis("v / px", scaleanchor="x", scaleratio=1, constrain="domain"),
        ),
        height=440,
        wide=False,
    )


def rotation_map(joined: Joined) -> Figure | None:
    """Rotations of the poses in three views; None without poses."""
    shown = joined.drawn
    if shown.poses is None or shown.group is None:
        return None
    w = np.degrees(shown.poses.rotation_vectors())
    groups = np.array(shown.group)
    limit = 1.12 * float(np.abs(w).max(initial=0.0)) or 1.0
    data: list[dict[str, Any]] = []
    extra: dict[str, Any] = {}
    for panel, (a, b) in enumerate(((0, 1), (0, 2), (1, 2))):
        suffix = "" if panel == 0 else str(panel + 1)
        left = panel * 0.355
        extra[f"xaxis{suffix}"] = axis(
            f"about {'xyz'[a]} / °", domain=[left, left + 0.27], anchor=f"y{suffix}", range=[-limit, limit], nticks=5
        )
        extra[f"yaxis{suffix}"] = axis(f"about {'xyz'[b]} / °", anchor=f"x{suffix}", range=[-limit, limit], nticks=5)
        for name in [g for g in ROTATION_COLOURS if (groups == g).any()]:
            k = groups == name
            data.append(
                {
                    "type": "scatter",
                    "mode": "markers",
                    "name": name,
                    "x": w[k, a],
                    "y": w[k, b],
                    "xaxis": f"x{suffix}",
                    "yaxis": f"y{suffix}",
                    "legendgroup": name,
                    "showlegend": panel == 0,
                    "marker": {"size": 6, "color": ROTATION_COLOURS[name]},
                    "hovertemplate": "%{x:.3f}°, %{y:.3f}°<extra></extra>",
                }
            )
    return Figure(
        title="Coverage of rotations",
        meaning="The rotation vector of each pose, seen along three axes." + joined.drawn_words,
        look_for="Points on the axes only are single rotations: they cannot distinguish one order of the angles "
        "from another; points off the axes can.",
        data=data,
        layout=layout(**extra),
        height=320,
    )


def table_angles(joined: Joined) -> Figure | None:
    """Table angles as a dial; None without poses."""
    if joined.poses is None:
        return None
    degrees = np.round(np.degrees(joined.poses.alpha) % 360.0, 3)
    values, counts = np.unique(degrees, return_counts=True)
    return Figure(
        title="Coverage of table angles",
        meaning="How many poses were imaged at each angle of the rotary table.",
        look_for="With one angle only, d_SR, u_0 and detector roll cannot be distinguished from the mount; two angles "
        "90° apart distinguish them.",
        data=[
            {
                "type": "barpolar",
                "r": counts,
                "theta": values,
                "width": [9.0] * len(values),
                "marker": {"color": ACCENT},
                "hovertemplate": "%{theta}°: %{r} poses<extra></extra>",
            }
        ],
        layout=layout(
            polar={
                "angularaxis": {"tickvals": [0, 45, 90, 135, 180, 225, 270, 315], "gridcolor": LINE, "ticksuffix": "°"},
                "radialaxis": {"gridcolor": LINE, "nticks": 4, "angle": 22, "tickangle": 0},
                "bgcolor": "#ffffff",
            },
            margin={"l": 40, "r": 40, "t": 30, "b": 30},
        ),
        height=440,
        wide=False,
    )


def correlation(covariance: ArrayLike) -> Array:
    """Correlation matrix; NaN in rows that have no variance."""
    covariance = np.asarray(covariance, dtype=np.float64)
    variance = np.diag(covariance)
    sigma = np.sqrt(np.where(variance > 0, variance, np.nan))
    result: Array = covariance / np.outer(sigma, sigma)
    return result


def correlation_map(calibration: Calibration) -> Figure:
    """Correlations of all estimated coordinates."""
    rho = correlation(calibration.covariance)
    names = [symbol(n) for n in calibration.tangent]
    few = len(names) <= 16
    return Figure(
        title="Correlations",
        meaning="How far an error in one parameter can hide in another: ±1 means that only their combination is known.",
        look_for="Pairs near ±1 are normal for t_HT and t (the paper saw it too); they cancel in the scan. Between a "
        "mount and a scanner parameter they ask for more table angles.",
        data=[
            {
                "type": "heatmap",
                "z": np.round(rho, 4),
                "x": names,
                "y": names,
                "zmin": -1,
                "zmax": 1,
                "colorscale": DIVERGING,
                "xgap": 1,
                "ygap": 1,
                "texttemplate": "%{z:.2f}" if few else "",
                "textfont": {"size": 10.5},
                "colorbar": colour_bar("ρ"),
                "hovertemplate": "%{y}, %{x}: %{z:.4f}<extra></extra>",
            }
        ],
        layout=layout(
            xaxis=axis(type="category", showgrid=False, ticks="", side="bottom"),
            yaxis=axis(type="category", showgrid=False, ticks="", autorange="reversed"),
            margin={"l": 60, "r": 10, "t": 14, "b": 60},
        ),
        height=440,
        wide=False,
    )


def singular_values(calibration: Calibration) -> Figure:
    """Singular values of the scaled Jacobian."""
    s = np.asarray(calibration.observability.singular_values, dtype=np.float64)
    words = (
        "below 100 is healthy, and a last bar that falls off by orders of magnitude is a direction the poses cannot "
        "determine."
        if calibration.model == "rigid"
        else "a long tail is normal where a manipulator's errors are estimated: priors hold what the poses "
        "cannot determine."
    )
    wide_range = s.size > 0 and s.min() > 0 and s.max() / s.min() > 200
    return Figure(
        title="Singular values",
        meaning="How strongly the data hold each independent direction of the parameters, strongest first.",
        look_for=f"Their ratio is the condition number, here {calibration.observability.condition:.3g}; {words}",
        data=[
            {
                "type": "bar",
                "x": np.arange(1, s.size + 1),
                "y": np.where(s > 0, s, np.nan),
                "marker": {"color": ACCENT},
                "hovertemplate": "%{y:.4g}<extra></extra>",
            }
        ],
        layout=layout(
            xaxis=axis("direction", dtick=1 if s.size <= 16 else 5),
            yaxis=axis("singular value", type="log", dtick=1 if wide_range else "D2"),
            bargap=0.45,
        ),
        height=440,
        wide=False,
    )


def scan_effect(scan: ProjectionMatrices) -> Figure | None:
    """Predicted standard uncertainty of projected points, by view; None where the matrices hold none."""
    if scan.points_sigma is None:
        return None
    sigma = np.asarray(scan.points_sigma)
    number = np.arange(1, len(sigma) + 1)
    traces = []
    for name, values, colour in (
        ("largest in the field of view", np.nanmax(sigma, axis=1), ORANGE),
        ("root mean square", np.sqrt(np.nanmean(sigma**2, axis=1)), ACCENT),
    ):
        traces.append(
            {
                "type": "scatter",
                "mode": "lines",
                "x": number,
                "y": values,
                "name": name,
                "line": {"color": colour, "width": 1.8},
                "hovertemplate": "view %{x}: %{y:.4~g} px<extra></extra>",
            }
        )
    return Figure(
        title="Expected effect on the scan",
        meaning="Standard uncertainty with which this calibration predicts the pixels of object points, by view.",
        look_for="It should stay well below half a pixel; peaks mark poses outside of the range that was calibrated.",
        data=traces,
        layout=layout(xaxis=axis("view"), yaxis=axis("σ / px", rangemode="tozero")),
        height=330,
    )
