"""The spectra of the wedge tests 2D-SW-1 to 3, as photons and as a detector weighs them.

The scenarios of the toolbox state the tube of the other tests: tungsten, electrons in and beam out at 45 degrees, a
window of 4 mm of aluminium. They name spectrum files that are not published, and the model that made them is not
published as code. The models of spekpy at 45 degrees differ by more than these tests allow, so that the stated angle
does not determine a spectrum. Two numbers of the one tube are therefore determined: anode angle and thickness of the
aluminium window for which spekpy's spectra come nearest to the Monte Carlo ratios between the steps of the wedges
before the ideal detector, five references at 120 and 200 kV, of aluminium and iron, with and without copper. The
references of the scintillators play no part in it.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
from ctsimu.evaluation.test2D_SW_1 import Test2D_SW_1_results
from ctsimu.evaluation.test2D_SW_2 import Test2D_SW_2_results
from images import wedge_materials
from samples import ALUMINIUM, IRON
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


@dataclass(frozen=True, eq=False)
class Reference:
    """Grey values behind the steps of a wedge before the ideal detector; copper: mm."""

    voltage: float
    wedge: str
    copper: float
    results: type
    name: str

    @property
    def ratios(self) -> tuple[np.ndarray, np.ndarray]:
        """Of neighbouring steps, and their error bars."""
        read = self.results()
        read.loadReference(self.name)
        grey, error = np.array(read.means_mc_primary), np.array(read.error_mc_primary_upper)
        wanted = grey[1:] / grey[:-1]
        return wanted, wanted * np.hypot(error[1:] / grey[1:], error[:-1] / grey[:-1])

    def misfit(self, bare: Spectrum, window: float) -> float:
        """Sum of squared deviations of the spectrum behind the window, in units of the error bars."""
        materials, (wanted, bars) = wedge_materials(), self.ratios
        passed = bare.filtered("Al", window, materials).filtered("Cu", self.copper, materials)
        lengths = np.array([*WEDGES[self.wedge], 0.0])
        mu = attenuation(self.wedge, passed.energy, materials=materials)
        ours = np.exp(-np.outer(lengths, mu)) @ (passed.weight * passed.energy)
        return float(np.sum(((ours[1:] / ours[:-1] - wanted) / bars) ** 2))


WEDGES = {"Al": ALUMINIUM, "Fe": IRON}
REFERENCES = (
    Reference(120.0, "Al", 0.0, Test2D_SW_1_results, "09_Al_noFilter_120kV-poly_Ideal"),
    Reference(200.0, "Al", 0.0, Test2D_SW_2_results, "01_Al_noFilter_200kV-poly_Ideal"),
    Reference(200.0, "Al", 2.0, Test2D_SW_2_results, "02_Al_CuFilter_200kV-poly_Ideal"),
    Reference(200.0, "Fe", 0.0, Test2D_SW_2_results, "03_Fe_noFilter_200kV-poly_Ideal"),
    Reference(200.0, "Fe", 2.0, Test2D_SW_2_results, "04_Fe_CuFilter_200kV-poly_Ideal"),
)
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
    """Least sum of squared deviations from all references' ratios of steps, in units of their error bars."""

    @functools.cache
    def best_window(angle: float) -> tuple[float, float]:
        bare = {v: tube_spectrum(v, anode_angle_deg=angle) for v in {r.voltage for r in REFERENCES}}
        best = minimize_scalar(
            lambda window: sum(r.misfit(bare[r.voltage], window) for r in REFERENCES), bounds=WINDOWS, method="bounded"
        )
        return float(best.fun), float(best.x)

    angle = float(
        minimize_scalar(lambda x: best_window(float(x))[0], bounds=ANGLES, method="bounded", options={"xatol": 0.05}).x
    )
    return TubeModel(angle=angle, window=best_window(angle)[1])
