"""Energy that stays in a scintillator, against a random walk of single photons that shares no code with it."""

from __future__ import annotations

import numpy as np
import pytest

from tomopose.errors import InputError
from tomopose.simulation.physics.materials import from_formula
from tomopose.simulation.physics.scintillator import deposited_energy
from tomopose.simulation.physics.spectrum import Spectrum

xraydb = pytest.importorskip("xraydb")

CSI, GOS = from_formula("CsI", 4.51), from_formula("Gd2O2S", 7.34)
WALKS = 40_000


def walked(material, thickness, energy, rng):
    """(mean, its standard error), keV: photons followed through all their collisions, one process at a time."""
    elements = list(material.fractions)
    mass = np.array([material.fractions[e] for e in elements]) * material.density / 10
    kept = np.zeros(WALKS)
    todo = [(np.full(WALKS, energy), np.zeros(WALKS), np.ones(WALKS), np.arange(WALKS))]
    while todo:
        E, x, c, who = todo.pop()
        if not len(E):
            continue
        grid = np.geomspace(3.0, 1.01 * energy, 600)

        def mu(element, kind, E=E, grid=grid):
            return np.exp(np.interp(np.log(E), np.log(grid), np.log(xraydb.mu_elam(element, grid * 1e3, kind=kind))))

        photo = np.array([m * mu(e, "photo") for e, m in zip(elements, mass, strict=True)])
        incoherent = sum(m * mu(e, "incoh") for e, m in zip(elements, mass, strict=True))
        x = x + c * rng.exponential(size=len(E)) / (photo.sum(axis=0) + incoherent)
        inside = (x > 0) & (x < thickness)
        E, x, who, photo, incoherent = E[inside], x[inside], who[inside], photo[:, inside], incoherent[inside]
        pick = rng.random(len(E)) * (photo.sum(axis=0) + incoherent)
        compton = pick < incoherent
        # Compton: cos(angle) by rejection from Klein and Nishina
        e, place, index = E[compton], x[compton], who[compton]
        angle = np.full(len(e), np.nan)
        while np.isnan(angle).any():
            open_ = np.flatnonzero(np.isnan(angle))
            u = rng.uniform(-1, 1, len(open_))
            r = 1 / (1 + e[open_] / 511.0 * (1 - u))
            take = rng.random(len(open_)) * 2 < r**2 * (r + 1 / r - 1 + u**2)
            angle[open_[take]] = u[take]
        after = e / (1 + e / 511.0 * (1 - angle))
        np.add.at(kept, index, e - after)
        todo.append((after, place, angle, index))  # it came along the normal, or is one of few that did not
        e, place, index, share = E[~compton], x[~compton], who[~compton], photo[:, ~compton]
        np.add.at(kept, index, e)
        chosen = (rng.random(len(e)) * share.sum(axis=0) > np.cumsum(share, axis=0)).sum(axis=0)
        for k, element in enumerate(elements):
            edge = xraydb.xray_edge(element, "K")
            if edge.energy < 5e3:
                continue
            mine = (chosen == k) & (e > edge.energy / 1e3)
            mine[mine] = rng.random(mine.sum()) < (1 - 1 / edge.jump_ratio) * edge.fyield
            lines = list(xraydb.xray_lines(element, "K").values())
            odds = np.array([line.intensity for line in lines])
            sent = np.array([line.energy for line in lines])[rng.choice(len(lines), mine.sum(), p=odds / odds.sum())]
            np.add.at(kept, index[mine], -sent / 1e3)
            todo.append((sent / 1e3, place[mine], rng.uniform(-1, 1, mine.sum()), index[mine]))
    return kept.mean(), kept.std() / np.sqrt(WALKS)


@pytest.mark.parametrize(
    ("material", "thickness", "energy"),
    [(CSI, 0.2, 30.0), (CSI, 0.2, 40.0), (CSI, 0.5, 60.0), (CSI, 0.6, 120.0), (GOS, 0.5, 45.0), (GOS, 0.5, 70.0)],
)
def test_what_stays_is_what_a_random_walk_leaves(material, thickness, energy):
    mean, error = walked(material, thickness, energy, np.random.default_rng(int(energy)))
    ours = deposited_energy(material, thickness, np.array([energy]))[0]
    assert abs(ours - mean) < 3 * error + 0.02 * mean, (ours, mean, error)


def test_above_the_k_edges_a_thin_layer_keeps_less_and_below_them_all():
    below, above = deposited_energy(CSI, 0.2, np.array([32.0, 38.0])) / [32.0, 38.0]
    assert above < 0.85
    assert below < 1
    assert deposited_energy(CSI, 5.0, np.array([20.0]))[0] == pytest.approx(20.0, rel=2e-3)


def test_a_spectrum_weighs_with_it_and_names_an_unknown_material():
    spectrum = Spectrum(energy=np.array([32.0, 38.0]), weight=np.ones(2))
    felt = spectrum.absorbed_energy(CSI, 0.2, escape=True)
    np.testing.assert_allclose(felt.weight, deposited_energy(CSI, 0.2, spectrum.energy))
    with pytest.raises(InputError, match="unobtainium"):
        spectrum.absorbed_energy("unobtainium", 0.2, escape=True)
