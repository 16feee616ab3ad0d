"""The multi-sphere standard (paper sec. 6.1): 27 ruby spheres of 5 mm on ceramic shafts over an Invar base.

The paper names the parts but not their positions, so the layout is this project's own: a sunflower spiral seen from
above, heights that jump from neighbour to neighbour, all 351 distances different.  data/standard.csv holds the
coordinates, as a calibration certificate would.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tomopose.simulation.objects.shapes import Solid, cylinder, sphere
from tomopose.simulation.physics.materials import table
from tomopose.units import Array

DIAMETER = 5.0
SHAFT_DIAMETER = 2.0
BASE_TOP = -45.0
BASE_RADIUS, BASE_HEIGHT = 48.0, 8.0


def standard_layout() -> Array:
    """(27, 3), mm, in the standard's own frame: z up, the origin in the middle of the spheres.  Source of
    data/standard.csv."""
    k = np.arange(27)
    angle = k * np.pi * (3 - np.sqrt(5))
    radius = 40.0 * np.sqrt((k + 0.5) / 27)
    # 10 mod 27 spreads neighbours on the spiral over the height, so that no sphere hides behind the next one's shaft.
    z = -30.0 + 60.0 * ((10 * k) % 27) / 26 + 0.37 * np.cos(3 * angle)
    return np.round(np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1), 4)


def sphere_centres() -> Array:
    """(27, 3), mm: the coordinates file."""
    return table("standard")[1][:, 1:4]


def sphere_diameters() -> Array:
    """(27,), mm."""
    return table("standard")[1][:, 4]


def multi_sphere_standard(*, shafts: bool = True, base: bool = True) -> tuple[Solid, ...]:
    """The standard as solids in its own frame; each sphere is displaced by no shaft, each shaft ends at its sphere."""
    solids: list[Solid] = []
    if base:
        solids.append(
            Solid(shape=cylinder(BASE_RADIUS, BASE_TOP - BASE_HEIGHT, BASE_TOP), material="Invar", name="base")
        )
    for k, (c, d) in enumerate(zip(sphere_centres(), sphere_diameters(), strict=True)):
        at: dict[str, Any] = {"t": c}
        if shafts:
            shaft = cylinder(SHAFT_DIAMETER / 2, BASE_TOP - c[2], -d / 2 + 0.3).placed(**at)
            solids.append(Solid(shape=shaft, material="alumina", name=f"shaft {k + 1}"))
        solids.append(Solid(shape=sphere(d / 2).placed(**at), material="ruby", name=f"sphere {k + 1}"))
    return tuple(solids)
