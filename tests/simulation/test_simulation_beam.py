"""Attenuation against NIST's tables; spectra; the condensed spectrum against the full one."""

from __future__ import annotations

import numpy as np
import pytest

from tomopose.errors import InputError
from tomopose.simulation.physics.attenuation import attenuated
from tomopose.simulation.physics.materials import MATERIALS, Material, attenuation, from_formula
from tomopose.simulation.physics.spectrum import CONDENSED_ERROR, Spectrum, condense, tube_spectrum

# Mass attenuation coefficients, cm2/g: Hubbell and Seltzer, NISTIR 5632 (NIST Standard Reference Database 126,
# physics.nist.gov/xaamdi); C, Al and Cu compared with its pages as github.com/ehsteve/roentgen keeps them.
ENERGY = (20.0, 30.0, 40.0, 50.0, 60.0, 80.0, 100.0, 150.0, 200.0)
NIST = {
    "C": (0.4420, 0.2562, 0.2076, 0.1871, 0.1753, 0.1610, 0.1514, 0.1347, 0.1229),
    "Al": (3.441, 1.128, 0.5685, 0.3681, 0.2778, 0.2018, 0.1704, 0.1378, 0.1223),
    "Cu": (33.79, 10.92, 4.862, 2.613, 1.593, 0.7630, 0.4584, 0.2217, 0.1559),
    "W": (65.73, 22.73, 10.67, 5.949, 3.713, 7.810, 4.438, 1.581, 0.7844),
}


@pytest.mark.parametrize("element", NIST)
def test_attenuation_is_that_of_nist_within_two_percent(element):
    mu = attenuation(from_formula(element, 10.0), ENERGY)
    np.testing.assert_allclose(mu, NIST[element], rtol=0.02)


def test_the_table_of_the_package_is_that_of_xraydb():
    xraydb = pytest.importorskip("xraydb")
    energy = np.array([10.5, 33.5, 69.5, 70.5, 120.5, 200.5])
    for element in ("H", "O", "Al", "Fe", "Cs", "I", "W"):
        expected = xraydb.mu_elam(element, energy * 1e3, kind="total")
        np.testing.assert_allclose(attenuation(from_formula(element, 10.0), energy), expected, rtol=5e-5)


def test_other_elements_come_from_xraydb():
    pytest.importorskip("xraydb")
    assert attenuation(from_formula("Pb", 11.35), [100.0])[0] / 1.135 == pytest.approx(5.549, rel=0.02)


def test_compounds_weigh_their_elements():
    water = from_formula("H2O", 1.0)
    assert water.fractions["H"] == pytest.approx(0.1119, abs=1e-4)
    assert attenuation(water, [60.0])[0] * 10 == pytest.approx(0.2059, rel=0.02)


def test_tubes_end_at_their_voltage_and_harden_behind_filters():
    for voltage in (100.0, 120.0, 180.0):
        bare = tube_spectrum(voltage)
        assert bare.energy.max() <= voltage
        assert bare.filtered("Cu", 0.5).mean_energy > bare.mean_energy + 5


def test_another_voltage_asks_spekpy():
    pytest.importorskip("spekpy")
    a, b = tube_spectrum(119.0), tube_spectrum(120.0)
    assert a.mean_energy == pytest.approx(b.mean_energy, rel=0.01)


def test_the_condensed_spectrum_transmits_what_the_full_one_does(rng):
    spectrum = tube_spectrum(120.0).filtered("Cu", 0.5).absorbed_energy("CsI", 0.6)
    names, longest = ("PEEK", "Al", "WC-Co"), np.array([12.0, 40.0, 8.0])
    beam = condense(spectrum, names, longest)
    assert len(beam.w) < 20
    assert beam.w.sum() == pytest.approx(1.0, abs=1e-12)
    L = rng.random((500, 3)) ** 3 * longest
    mu = np.stack([attenuation(n, spectrum.energy) for n in names], axis=1)
    full = np.exp(-L @ mu.T) @ (spectrum.weight / spectrum.weight.sum())
    assert np.abs(beam.transmission(L) - full).max() < 3 * CONDENSED_ERROR


@pytest.mark.parametrize("voltage", [120.0, 180.0])
@pytest.mark.parametrize(
    ("names", "longest"), [(("ruby",), 135.0), (("ruby", "alumina", "Invar"), 90.0), (("air",), 1000.0), (("W",), 0.01)]
)
def test_every_spectrum_can_be_condensed(voltage, names, longest, rng):
    for filters in ((), (("Al", 2.0),)):
        spectrum = tube_spectrum(voltage).absorbed_energy("CsI", 0.6)
        for material, thickness in filters:
            spectrum = spectrum.filtered(material, thickness)
        beam = condense(spectrum, names, [longest] * len(names))
        L = np.outer(rng.random(40), np.full(len(names), longest / len(names)))
        mu = np.stack([attenuation(n, spectrum.energy) for n in names], axis=1)
        full = np.exp(-L @ mu.T) @ (spectrum.weight / spectrum.weight.sum())
        assert np.abs(beam.transmission(L) - full).max() < 3 * CONDENSED_ERROR


def test_kernels_attenuate_as_the_sum_does(rng):
    spectrum = tube_spectrum(120.0).filtered("Cu", 0.5).absorbed_energy("CsI", 0.6)
    beam = condense(spectrum, ("PEEK", "Al", "WC-Co"), (12.0, 40.0, 8.0))
    L = rng.random((300, 3)) * [60.0, 90.0, 12.0]
    # One material: the table.  Several: the sum.
    alone = np.concatenate([np.outer(L[:, m], np.eye(3)[m]) for m in range(3)])
    for paths, limit in ((alone, 2e-9), (L, 2e-9), (1e-3 * L, 2e-9)):
        mine = np.array([attenuated(beam.arrays, row) for row in paths])
        assert np.abs(mine - beam.transmission(paths)).max() < limit
    assert attenuated(beam.arrays, np.zeros(3)) == 1.0
    assert attenuated(beam.arrays, np.array([0.0, 0.0, 1e4])) == 0.0


@pytest.mark.parametrize(
    "make",
    [
        lambda: from_formula("Al(2)", 1.0),
        lambda: from_formula("al", 1.0),
        lambda: from_formula("Al", -1.0),
        lambda: Material(density=1.0, fractions={"Al": 0.5}),
        lambda: attenuation("adamantium", [50.0]),
        lambda: Spectrum(energy=np.array([1.0]), weight=np.array([0.0])),
        lambda: tube_spectrum(120.0).filtered("Al", -1.0),
    ],
)
def test_impossible_matter_is_refused(make):
    with pytest.raises(InputError):
        make()


def test_named_materials_exist():
    for name in MATERIALS:
        assert (attenuation(name, [60.0]) > 0).all()
