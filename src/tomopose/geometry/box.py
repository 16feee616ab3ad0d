"""Corners of a box."""

from __future__ import annotations

from itertools import product

from tomopose.units import float_array

BOX_CORNERS = float_array(list(product((-1.0, 1.0), repeat=3)))
"""(8, 3): corners of the cube |x|, |y|, |z| <= 1, z fastest.  Times half sizes, plus a centre: those of a box."""
