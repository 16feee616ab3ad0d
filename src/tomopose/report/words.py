"""Names, units and numbers as people read them."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from types import MappingProxyType
from typing import SupportsFloat

import numpy as np
from numpy.typing import ArrayLike

from tomopose.units import MICROMETRES_PER_MM, MICRORADIANS_PER_RAD

NOT_DETERMINABLE, NOT_GIVEN = "not determinable", "not given"

MEANINGS: Mapping[str, str] = MappingProxyType(
    {
        "phi_HT": "orientation of the manipulator on the table, R = R_x R_y R_z, about {axis}",
        "w_HT": "small rotation of the manipulator on the table, about {axis}",
        "t_HT": "position of the manipulator's origin on the table, along {axis}",
        "t": "ball centre on the moved plate, along {axis}",
        "d_SD": "source to detector",
        "d_SR": "source to table axis",
        "u_0": "piercing point, along u",
        "v_0": "piercing point, along v",
        "p_u": "pixel pitch along u",
        "p_v": "pixel pitch along v",
        "eta": "detector roll about the beam",
        "theta": "detector tilt about u",
        "phi": "detector tilt about v",
        "axis_y": "offset of the table axis",
        "axis_tilt_x": "tilt of the table axis about x",
        "axis_tilt_y": "tilt of the table axis about y",
        "pitch_ratio": "ratio of the pixel pitches",
        "scale": "scale of the manipulator's translations",
    }
)
HEADINGS: Mapping[str, str] = MappingProxyType(
    {"delta_chi2": "Δχ²", "words": "reading of the data", "cure": "to try it", "d_rms_px": "d_rms / px"}
)
GREEK = (("phi_", "φ_"), ("w_", "ω_"), ("eta", "η"), ("theta", "θ"), ("phi", "φ"))
AXIS_NAME = re.compile(r"(?P<stem>phi_HT|w_HT|t_HT|t)(?:\[(?P<ball>-?\d+)\])?_(?P<axis>[xyz])")


LONGEST_SYMBOL = 8


def meaning(name: str) -> str:
    """What a parameter is, in words; empty where it is not known here."""
    found = AXIS_NAME.fullmatch(name)
    if found:
        ball = f" (ball {found['ball']})" if found["ball"] is not None else ""
        return MEANINGS[found["stem"]].format(axis=found["axis"]) + ball
    return MEANINGS.get(name, "")


def symbol(name: str) -> str:
    """A parameter's name with its index set low, for figures."""
    text = name
    for plain_name, greek in GREEK:
        if text.startswith(plain_name):
            text = greek + text[len(plain_name) :]
            break
    if len(text) > LONGEST_SYMBOL:
        return text.replace("_", " ")
    stem, _, index = text.partition("_")
    return f"{stem}<sub>{index.replace('_', ',')}</sub>" if index else stem


def small_unit(u: float, unit: str) -> str:
    """A standard uncertainty in µm or µrad where the unit is mm or rad; `not determinable` where it is no number."""
    if not math.isfinite(u) or u <= 0:
        return NOT_DETERMINABLE
    factor, name = {"mm": (MICROMETRES_PER_MM, "µm"), "rad": (MICRORADIANS_PER_RAD, "µrad")}.get(unit, (1.0, unit))
    return f"{number(u * factor)} {name}".rstrip()


def number(value: SupportsFloat) -> str:
    """A number with three figures, without an exponent where it is easy to read."""
    x = float(value)
    if not math.isfinite(x):
        return NOT_DETERMINABLE
    if x == 0:
        return "0"
    exponent = math.floor(math.log10(abs(x)))
    return f"{x:.{min(max(2 - exponent, 0), 8)}f}" if -5 <= exponent < 6 else f"{x:.3g}"


def with_unit(value: SupportsFloat, unit: str) -> str:
    """A number with three figures and its unit; no unit where there is no number."""
    return f"{number(value)} {unit}" if math.isfinite(float(value)) else NOT_DETERMINABLE


def decimals(values: ArrayLike) -> int:
    """Digits after the point that show three figures of the rms of values."""
    x = np.asarray(values, dtype=np.float64)
    rms = float(np.sqrt(np.mean(x**2))) if x.size else 0.0
    return max(0, 2 - math.floor(math.log10(rms))) if math.isfinite(rms) and rms > 0 else 3


def cell(value: object) -> str:
    """Any value of a result as the text of a table cell."""
    if value is None:
        return "–"
    if isinstance(value, (bool, np.bool_)):
        return "yes" if value else "no"
    if isinstance(value, (int, np.integer)):
        return str(int(value))
    if isinstance(value, (float, np.floating)):
        return number(value)
    if isinstance(value, (list, tuple, np.ndarray)):
        return ", ".join(cell(v) for v in value)
    if isinstance(value, Mapping):
        return "; ".join(f"{k}: {cell(v)}" for k, v in value.items())
    return str(value)


def heading(key: str) -> str:
    """A key of a result as a column's head: `delta_chi2` becomes `delta chi2`, `d_px` becomes `d / px`."""
    if key in HEADINGS:
        return HEADINGS[key]
    for unit, shown in (("_px", "px"), ("_um", "µm"), ("_mm", "mm"), ("_rad", "rad"), ("_deg", "°")):
        if key.endswith(unit) and len(key) > len(unit):
            return f"{key.removesuffix(unit).replace('_', ' ')} / {shown}"
    return key.replace("_", " ")
