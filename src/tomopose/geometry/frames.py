"""The six frames of the setup (paper sec. 2, figs. 1 to 3), and the one rule for the names of transforms.

`T_AB` maps coordinates in A to coordinates in B: x_B = T_AB @ x_A (eq. 1).  That is said here once; every transform in
the package is named by it.
"""

from __future__ import annotations

from enum import Enum


class Frame(Enum):
    """A coordinate system.  All but D are right-handed, in millimetres.

    S  source.  Origin at the X-ray spot, z towards the piercing point, x along the detector rows against u (x_S = -y_W
       side), y along its columns (eq. 4).
    W  world.  Origin where the central ray crosses the rotation axis; source at +x, z along the rotation axis, beam
       along -x.  Fixed in space.
    T  table.  Turns with the rotary table; equals W at alpha = 0.
    H  manipulator base ("hexapod").  Fixed to its base plate; origin at the set pivot point.
    M  manipulator's moved plate (the paper's H with a tilde).  Equals H at the zero pose.
    D  detector.  Pixels; (0, 0) is the centre of the bottom-left pixel, u to the right and v up, seen from the source.
    """

    S = "source"
    W = "world"
    T = "table"
    H = "manipulator base"
    M = "manipulator's moved plate"
    D = "detector"
