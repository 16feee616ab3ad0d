"""How figures look: one quiet layout and one set of colours, so that colour always means the same."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

INK, SOFT, LINE, ACCENT, ALERT = "#1d2733", "#5b6775", "#dde3ea", "#1f5f99", "#b3261e"
ORANGE = "#d9792b"
FONT = '"Inter", "Source Sans 3", "Segoe UI", "Helvetica Neue", Arial, "DejaVu Sans", sans-serif'

NO_ROTATION, COMPOUND = "none", "compound"
ROTATION_COLOURS: Mapping[str, str] = MappingProxyType(
    {
        NO_ROTATION: "#4a4a4a",
        "+x": "#b2433f",
        "−x": "#e69a93",
        "+y": "#1f5f99",
        "−y": "#86b6de",
        "+z": "#2b7d4f",
        "−z": "#8fcba6",
        COMPOUND: "#8a6bb1",
    }
)
"""Colour of a pose by the axis and sign of its rotation, as in the paper's fig. 8."""

DIVERGING = [[0.0, "#1f5f99"], [0.25, "#8db8dc"], [0.5, "#f7f7f5"], [0.75, "#e3a18c"], [1.0, "#a63a28"]]
SEQUENTIAL = [[0.0, "#0b2d57"], [0.35, "#2f77a8"], [0.65, "#8fbf9f"], [1.0, "#f2d16b"]]


def axis(title: str = "", **changes: object) -> dict[str, Any]:
    """A two-dimensional axis."""
    return {
        "title": {"text": title, "standoff": 8, "font": {"size": 12.5}},
        "gridcolor": "#edf0f4",
        "zerolinecolor": "#c6ced8",
        "linecolor": "#aab4c0",
        "showline": True,
        "ticks": "outside",
        "ticklen": 4,
        "tickcolor": "#aab4c0",
        "automargin": True,
        "exponentformat": "none",
        **changes,
    }


def layout(**changes: object) -> dict[str, Any]:
    """The layout that every figure begins from."""
    return {
        "font": {"family": FONT, "size": 12.5, "color": INK},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "#ffffff",
        "margin": {"l": 58, "r": 20, "t": 34, "b": 48},
        "legend": {"orientation": "h", "x": 0, "y": 1.0, "yanchor": "bottom", "font": {"size": 12}},
        "modebar": {"bgcolor": "rgba(255,255,255,0.85)", "color": "#aab4c0", "activecolor": ACCENT},
        "hoverlabel": {"font": {"family": FONT, "size": 12.5}},
        "xaxis": axis(),
        "yaxis": axis(),
        **changes,
    }


def space_axis(title: str, **changes: object) -> dict[str, Any]:
    """An axis of a 3-D scene, mm."""
    return {
        "title": {"text": title, "font": {"size": 12}},
        "gridcolor": "#dfe5eb",
        "zerolinecolor": "#c6ced8",
        "backgroundcolor": "#fafbfc",
        "showbackground": True,
        "tickfont": {"size": 10.5},
        **changes,
    }


def colour_bar(title: str, **changes: object) -> dict[str, Any]:
    return {
        "title": {"text": title, "side": "right", "font": {"size": 12}},
        "thickness": 12,
        "outlinewidth": 0,
        "exponentformat": "none",
        "tickfont": {"size": 11},
        **changes,
    }


def label(text: str, x: float, y: float, **changes: object) -> dict[str, Any]:
    """A line of text in a figure's own coordinates (0 .. 1)."""
    return {
        "text": text,
        "x": x,
        "y": y,
        "xref": "paper",
        "yref": "paper",
        "showarrow": False,
        "font": {"size": 12.5, "color": SOFT},
        **changes,
    }
