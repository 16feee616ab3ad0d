r"""What a photon leaves in a scintillator: E less what escapes as K fluorescence and as Compton-scattered photons.

A photon of energy E that enters a layer of thickness t interacts at depth x with density mu exp(-mu x), mu without
coherent scattering, which changes neither its energy nor, much, its direction.

Photoelectric, K shell of element i (share 1 - 1 / jump ratio of its part): with probability omega_K a line of energy
E_l is emitted, equally in all directions.  Of a plane source at depth x the share
1 - (E_2(mu_l x) + E_2(mu_l (t - x))) / 2 is absorbed in the layer, E_2 the exponential integral.  All else stays.

Compton: a photon of energy E' leaves at an angle to E by Klein and Nishina (Z. Phys. 52 (1929) 853); E - E' stays, and
of E' what the photoelectric effect takes on the straight way out.

One generation is followed: photons that scatter twice and K lines of K lines are left out (a random walk that follows
them, in the tests, differs by less than 2 %).
Yields, jumps and lines are those of Elam, Ravel and Sieber (Radiat. Phys. Chem. 63 (2002) 121), by xraydb.
"""

from __future__ import annotations

import numpy as np
from scipy.special import expn

from tomopose.simulation.physics.materials import CM2_PER_G_TO_MM, Material, xraydb
from tomopose.units import Array

ELECTRON_KEV = 510.998950
"""Rest energy of the electron (CODATA 2018)."""
DEPTHS, ANGLES = 96, 48
"""Nodes of Gauss and Legendre over depth and cos(angle); twice as many change 0.2 to 2 mm of CsI by at most 6e-4."""
SOFTEST_KEV = 5.0
"""Lines below are absorbed where they are made."""


def _mu_of(material: Material, element: str, energy: Array, process: str) -> Array:
    """1/mm: what one element of a material attenuates by one process, "photo" or "incoh"."""
    mu = xraydb().mu_elam(element, energy * 1e3, kind=process)
    return np.asarray(material.fractions[element] * mu * material.density * CM2_PER_G_TO_MM)


def _mu(material: Material, energy: Array, process: str) -> Array:
    """1/mm: attenuation by one process."""
    return np.asarray(sum(_mu_of(material, element, energy, process) for element in material.fractions))


def deposited_energy(material: Material, thickness: float, energy: Array) -> Array:
    """keV (n,): mean energy that a photon of `energy` (n,) keV leaves in a layer of `thickness`, mm."""
    E = np.asarray(energy, dtype=np.float64)
    tau, sigma = _mu(material, E, "photo"), _mu(material, E, "incoh")
    node, weight = np.polynomial.legendre.leggauss(DEPTHS)
    x = thickness * (node + 1) / 2
    # interactions at each depth, per photon
    density = np.exp(-(tau + sigma)[:, None] * x) * weight * thickness / 2
    photo = E[:, None] - _escaping_fluorescence(material, thickness, E, tau, x)
    stays = np.sum(density * tau[:, None] * photo, axis=1)
    scattered = _kept_of_compton(material, thickness, E, x)
    return np.asarray(stays + np.sum(density * sigma[:, None] * scattered, axis=1))


def _escaping_fluorescence(material: Material, thickness: float, E: Array, tau: Array, x: Array) -> Array:
    """keV (n, m): what K lines carry out, for each photoelectric event (tau (n,) 1/mm) at depths x (m,)."""
    lost = np.zeros((len(E), len(x)))
    for element in material.fractions:
        edge = xraydb().xray_edge(element, "K")
        edge_keV = edge.energy / 1e3
        if edge_keV < SOFTEST_KEV:
            continue
        own = _mu_of(material, element, E, "photo")
        chance = np.where(edge_keV < E, own / tau * (1 - 1 / edge.jump_ratio) * edge.fyield, 0.0)
        for line in xraydb().xray_lines(element, "K").values():
            E_l = line.energy / 1e3
            mu_l = float(_mu(material, np.array([E_l]), "photo")[0])
            out = (expn(2, mu_l * x) + expn(2, mu_l * (thickness - x))) / 2
            lost += np.outer(chance, line.intensity * E_l * out)
    return lost


def _kept_of_compton(material: Material, thickness: float, E: Array, x: Array) -> Array:
    """keV (n, m): what a Compton event at depths x (m,) leaves in the layer."""
    cosine, weight = np.polynomial.legendre.leggauss(ANGLES)
    scattered = E[:, None] / (1 + E[:, None] / ELECTRON_KEV * (1 - cosine))
    r = scattered / E[:, None]
    chance = r**2 * (r + 1 / r - (1 - cosine**2)) * weight
    chance /= chance.sum(axis=1, keepdims=True)
    mu = _mu(material, scattered.ravel(), "photo").reshape(scattered.shape)
    kept = np.zeros((len(E), len(x)))
    for i, c in enumerate(cosine):
        way = (thickness - x if c > 0 else x) / abs(c)
        absorbed = 1 - np.exp(-mu[:, i, None] * way)
        kept += chance[:, i, None] * (E[:, None] - scattered[:, i, None] * (1 - absorbed))
    return kept
