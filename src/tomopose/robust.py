"""Constants of robust statistics, for a normal distribution.

Source: P. J. Huber, Robust Statistics (1981), sec. 5.1.
"""

from __future__ import annotations

MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal variable over its median absolute deviation: 1 / Phi^-1(3/4)."""
NORMAL_MEDIAN = 0.455
"""Median of the square of a standard normal variable: Phi^-1(3/4)^2."""
