"""The spectrum that the detector feels, and polychromatic Beer-Lambert with as few energies as accuracy allows.

T = sum_E w(E) exp(-sum_m mu_m(E) L_m), where w(E) = photons x filters x response, normalised to 1.  `condense` replaces
the hundred or so energies by a dozen of them with new weights (non-negative least squares), which makes the sum ten
times cheaper per ray and wrong by less than `CONDENSED_ERROR`.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tomopose.errors import EngineMissingError, InputError, ShapeError
from tomopose.simulation.physics.attenuation import tabulated
from tomopose.simulation.physics.materials import MATERIALS, Material, attenuation, known_material, table
from tomopose.simulation.physics.scintillator import deposited_energy
from tomopose.units import Array, float_array
from tomopose.values import value

MOST_STEPS = 1000
CONDENSED_ERROR = 1e-5
"""Largest error of a transmission computed with the condensed spectrum, as a share of the unattenuated beam."""


@dataclass(frozen=True, kw_only=True)
class Tube:
    """Voltage (kV), material and angle (deg) of the anode."""

    voltage: float
    anode: str
    anode_angle_deg: float


@value
class Spectrum:
    """energy (n,), keV; weight (n,), relative: photons, or what a detector makes of them.

    Where it comes from, as far as it is known: tube, filters and scintillator (material, mm).
    """

    energy: Array
    weight: Array
    tube: Tube | None = None
    filters: tuple[tuple[Material | str, float], ...] = ()
    scintillator: tuple[Material | str, float] | None = None

    def __post_init__(self) -> None:
        energy, weight = float_array(self.energy), float_array(self.weight)
        if energy.ndim != 1 or energy.shape != weight.shape or not energy.size:
            raise ShapeError(f"a spectrum needs energy (n,) and weight (n,); got {energy.shape} and {weight.shape}")
        if not (np.isfinite(energy).all() and np.isfinite(weight).all() and (energy > 0).all() and (weight >= 0).all()):
            raise InputError("a spectrum needs positive energies (keV) and weights that are finite and not negative")
        if not weight.sum() > 0:
            raise InputError("the spectrum is empty: all weights are 0")
        object.__setattr__(self, "energy", energy)
        object.__setattr__(self, "weight", weight)

    @property
    def mean_energy(self) -> float:
        """keV."""
        return float(self.energy @ self.weight / self.weight.sum())

    def filtered(
        self, material: Material | str, thickness: float, materials: Mapping[str, Material] = MATERIALS
    ) -> Spectrum:
        """Behind a plate of that material and thickness (mm)."""
        if not thickness >= 0:
            raise InputError(f"filter {material}: thickness is {thickness} mm; it may not be negative")
        passed = np.exp(-attenuation(material, self.energy, materials=materials) * thickness)
        return replace(self, weight=self.weight * passed, filters=(*self.filters, (material, thickness)))

    def absorbed_energy(
        self,
        material: Material | str,
        thickness: float,
        materials: Mapping[str, Material] = MATERIALS,
        *,
        escape: bool = False,
    ) -> Spectrum:
        """As an energy-integrating scintillator of that material and thickness (mm) weighs it.

        escape: K fluorescence and Compton-scattered photons that leave the scintillator carry their energy away (needs
        xraydb); otherwise all energy stays of photons that interact.
        """
        if not thickness > 0:
            raise InputError(f"scintillator: thickness is {thickness} mm; a positive number is needed")
        if escape:
            energy = deposited_energy(known_material(material, materials), thickness, self.energy)
        else:
            energy = self.energy * (1 - np.exp(-attenuation(material, self.energy, materials=materials) * thickness))
        return replace(self, weight=self.weight * energy, scintillator=(material, thickness))


def tube_spectrum(voltage: float, *, anode: str = "W", anode_angle_deg: float = 12.0) -> Spectrum:
    """Photons of an X-ray tube (kV) without filter, in bins of 1 keV.

    Tungsten at 12 degrees and 100, 120 or 180 kV comes with the package (made by spekpy); everything else asks spekpy.
    """
    names, values = table("tungsten")
    tube = Tube(voltage=voltage, anode=anode, anode_angle_deg=anode_angle_deg)
    column = f"W_{voltage:g}kV"
    if anode == "W" and anode_angle_deg == 12.0 and column in names:
        weight = values[:, names.index(column)]
        keep = weight > 0
        return Spectrum(energy=values[keep, 0], weight=weight[keep], tube=tube)
    try:
        import spekpy
    except ImportError as error:
        known = ", ".join(n[2:] for n in names[1:])
        raise EngineMissingError(
            f"a spectrum of {anode} at {voltage:g} kV needs spekpy, which is not installed (with the package come W at "
            f"{known})",
            install_line='pip install "tomopose[sim]"',
        ) from error
    try:
        energy, weight = spekpy.Spek(kvp=voltage, th=anode_angle_deg, targ=anode, dk=1.0).get_spectrum()
    except Exception as error:
        raise InputError(f"spekpy gives no spectrum for {anode} at {voltage:g} kV: {error}") from error
    keep = (weight > 0) & (energy >= 6.0)
    return Spectrum(energy=energy[keep], weight=weight[keep], tube=tube)


@value
class Beam:
    """The condensed spectrum for given materials: T = sum_k w_k exp(-mu_k . L).

    w (k,) adds up to 1; mu (k, m), 1/mm; error: largest residual on the paths it was made for.
    """

    w: Array
    mu: Array
    error: float

    @functools.cached_property
    def arrays(self) -> tuple[Any, ...]:
        """What `attenuated` takes."""
        return self.w, self.mu, *tabulated(self.w, self.mu)

    def transmission(self, L: ArrayLike) -> Array:
        """Transmission (n,) of path lengths (n, m), mm."""
        return np.exp(-np.asarray(L) @ self.mu.T) @ self.w

    @property
    def of_first_material(self) -> tuple[tuple[float, float], ...]:
        """(share, attenuation in 1/mm by the first material) of each energy."""
        return tuple((float(w), float(mu)) for w, mu in zip(self.w, self.mu[:, 0], strict=True))


def condense(
    spectrum: Spectrum,
    materials: tuple[str, ...],
    longest: ArrayLike,
    materials_table: Mapping[str, Material] = MATERIALS,
) -> Beam:
    """A dozen energies that represent the whole spectrum.

    materials: the m names of path columns; longest: (m,) longest path in each, mm.  The weights are the non-negative
    least-squares solution over paths that fill the box up to `longest`; its answers are sparse by nature.
    """
    from scipy.linalg import qr
    from scipy.optimize import nnls

    mu = np.stack([attenuation(name, spectrum.energy, materials=materials_table) for name in materials], axis=1)
    w = spectrum.weight / spectrum.weight.sum()
    longest = np.asarray(longest, dtype=np.float64)
    rng = np.random.default_rng(np.random.SeedSequence(20231028))
    m = len(materials)
    share = rng.dirichlet(np.ones(m), size=400) * rng.random((400, 1)) ** 3 * m
    single = np.linspace(0, 1, 60)[:, None] ** 3
    L = np.concatenate([*(single * np.eye(m)[k] for k in range(m)), np.minimum(share, 1)]) * longest
    A = np.exp(-L @ mu.T)
    target = A @ w
    # The energies that differ most come first; the beam without object must come out exactly, so its row weighs most.
    order = qr(A, mode="r", pivoting=True)[1]
    for n in range(4, min(41, len(w)), 2):
        keep = np.sort(order[:n])
        try:
            solution, _ = nnls(
                np.vstack([A[:, keep], np.full((1, n), 1e3)]), np.append(target, 1e3), maxiter=MOST_STEPS
            )
        except RuntimeError:
            # It goes round in circles among nearly equal columns: another choice of energies, or all of them.
            continue
        solution /= solution.sum()
        error = float(np.abs(A[:, keep] @ solution - target).max())
        if error < CONDENSED_ERROR:
            used = solution > 0
            return Beam(w=float_array(solution[used]), mu=float_array(mu[keep][used]), error=error)
    return Beam(w=float_array(w), mu=float_array(mu), error=0.0)
