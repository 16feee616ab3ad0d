"""The colour map of deviations."""

from __future__ import annotations

import numpy as np

from tomopose.errors import EngineMissingError
from tomopose.measurement.surface.contour import INSTALL_LINE
from tomopose.units import Array


def vik(t: Array) -> np.ndarray:
    """Colours (..., 3), uint8, of places t (...) from 0 to 1 on the `vik` map (Crameri 2018).

    EngineMissingError without cmcrameri.
    """
    try:
        from cmcrameri import cm
    except ImportError as error:
        raise EngineMissingError("the colour map needs cmcrameri", install_line=INSTALL_LINE) from error
    return np.asarray(np.round(255 * np.asarray(cm.vik(t))[..., :3]), dtype=np.uint8)
