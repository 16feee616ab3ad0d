"""The spectra of the wedge tests 2D-SW-1 to 3, as photons and as a detector weighs them.

The scenarios of the toolbox state the tube of the other tests: tungsten, electrons in and beam out at 45 degrees, a
window of 4 mm of aluminium. They name spectrum files that are not published, and the model that made them is not
published as code. The models of spekpy at 45 degrees differ by more than these tests allow, so that the stated angle
does not determine a spectrum. Two numbers of the one tube are therefore determined from two references, at 120 and
200 kV: anode angle and thickness of the aluminium window for which spekpy's spectra give the Monte Carlo ratios between
the steps of the aluminium wedge, without filter, before the ideal detector. The references of iron, of both wedges
behind copper and of the scintillators play no part in it.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
from ctsimu.evaluation.test2D_SW_1 import Test2D_SW_1_results
from ctsimu.evaluation.test2D_SW_2 import Test2D_SW_2_results
from images import wedge_materials
from samples import ALUMINIUM
from scipy.optimize import minimize_scalar

from tomopose.simulation.physics.materials import attenuation
from tomopose.simulation.physics.spectrum import Spectrum, tube_spectrum

ANGLES, WINDOWS = (4.0, 30.0), (0.5, 8.0)
"""Where anode angle (deg) and window (mm Al) are sought."""


@dataclass(frozen=True, kw_only=True)
class TubeModel:
    """Anode angle (deg) and window (mm Al) of spekpy's tungsten spectrum that stands for the tube."""

    angle: float
    window: float

    def photons(self, voltage: float) -> Spectrum:
        bare = tube_spectrum(voltage, anode_angle_deg=self.angle)
        return bare.filtered("Al", self.window, wedge_materials())


REFERENCES = {
    120.0: (Test2D_SW_1_results, "09_Al_noFilter_120kV-poly_Ideal"),
    200.0: (Test2D_SW_2_results, "01_Al_noFilter_200kV-poly_Ideal"),
}
"""For each voltage, kV: the toolbox's class and the name of its reference."""
DETECTORS: dict[str, tuple[str, float] | None] = {
    "D1": None,
    "D2": ("CsI", 0.2),
    "D3": ("CsI", 0.5),
    "D4": ("Gd2O2S", 0.5),
}


def spectrum(voltage: float, *, mono: bool, copper: float = 0.0) -> Spectrum:
    """Photons of the tube behind its window and, where asked for, a copper filter (mm); or of one energy."""
    if mono:
        return Spectrum(energy=np.array([voltage]), weight=np.ones(1))
    made = tube_model().photons(voltage)
    return made.filtered("Cu", copper, wedge_materials()) if copper else made


def seen_by(photons: Spectrum, detector: str) -> Spectrum:
    part = DETECTORS[detector]
    if part is None:
        return replace(photons, weight=photons.weight * photons.energy)
    return photons.absorbed_energy(*part, wedge_materials(), escape=True)


@functools.cache
def tube_model() -> TubeModel:
    """Least sum of squared deviations from both references' ratios of steps, in units of their error bars."""
    wanted = {voltage: _steps(voltage) for voltage in REFERENCES}

    @functools.cache
    def best_window(angle: float) -> tuple[float, float]:
        felt = {voltage: seen_by(tube_spectrum(voltage, anode_angle_deg=angle), "D1") for voltage in REFERENCES}

        def misfit(window: float) -> float:
            return sum(_misfit(felt[voltage], window, *wanted[voltage]) for voltage in REFERENCES)

        best = minimize_scalar(misfit, bounds=WINDOWS, method="bounded")
        return float(best.fun), float(best.x)

    angle = float(
        minimize_scalar(lambda x: best_window(float(x))[0], bounds=ANGLES, method="bounded", options={"xatol": 0.05}).x
    )
    return TubeModel(angle=angle, window=best_window(angle)[1])


def _steps(voltage: float) -> tuple[np.ndarray, np.ndarray]:
    """The reference's ratios of neighbouring steps of the aluminium wedge, and their error bars."""
    reference, name = REFERENCES[voltage]
    read = reference()
    read.loadReference(name)
    grey, error = np.array(read.means_mc_primary), np.array(read.error_mc_primary_upper)
    wanted = grey[1:] / grey[:-1]
    return wanted, wanted * (error[1:] / grey[1:] + error[:-1] / grey[:-1])


def _misfit(felt: Spectrum, window: float, wanted: np.ndarray, bars: np.ndarray) -> float:
    mu = attenuation("Al", felt.energy, materials=wedge_materials())
    ours = np.exp(-np.outer(np.array([*ALUMINIUM, 0.0]) + window, mu)) @ felt.weight
    return float(np.sum(((ours[1:] / ours[:-1] - wanted) / bars) ** 2))
