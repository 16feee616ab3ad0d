"""Materials: what a solid is made of, and its linear attenuation coefficient.

The elements of common parts and detectors come with the package (data/attenuation.csv); any other element is looked
up in xraydb.  Both are the tables of Elam, Ravel and Sieber (Radiat. Phys. Chem. 63 (2002) 121).
"""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tomopose.errors import EngineMissingError, InputError
from tomopose.units import Array

CM2_PER_G_TO_MM = 0.1
"""cm2/g times g/cm3 is 1/cm; this makes it 1/mm."""

ATOMIC_WEIGHT = MappingProxyType(
    {
        "H": 1.008,
        "C": 12.011,
        "N": 14.007,
        "O": 15.999,
        "Mg": 24.305,
        "Al": 26.982,
        "Si": 28.085,
        "Mn": 54.938,
        "Fe": 55.845,
        "Co": 58.933,
        "Ni": 58.693,
        "Cu": 63.546,
        "Cs": 132.905,
        "I": 126.904,
        "W": 183.84,
    }
)
"""Standard atomic weights (IUPAC 2021) of the elements in the package's table."""


@dataclass(frozen=True, kw_only=True)
class Material:
    """density in g/cm3; fractions: element -> share of the mass, adding up to 1."""

    density: float
    fractions: Mapping[str, float]

    def __post_init__(self) -> None:
        if not (np.isfinite(self.density) and self.density > 0):
            raise InputError(f"material: density is {self.density} g/cm3; a positive number is needed")
        total = sum(self.fractions.values())
        if min(self.fractions.values(), default=-1) < 0 or abs(total - 1) > 1e-3:
            raise InputError(f"material: mass fractions {dict(self.fractions)} add up to {total:g}; 1 is needed")
        object.__setattr__(self, "fractions", MappingProxyType(dict(self.fractions)))

    def __reduce__(self) -> tuple[object, tuple[float, dict[str, float]]]:
        return _material, (self.density, dict(self.fractions))


def _material(density: float, fractions: dict[str, float]) -> Material:
    return Material(density=density, fractions=fractions)


def from_formula(formula: str, density: float) -> Material:
    """A compound by its chemical formula, such as "C19H12O3" (no brackets), and its density in g/cm3."""
    parts = re.findall(r"([A-Z][a-z]?)(\d*\.?\d*)", formula)
    if not parts or "".join(a + b for a, b in parts) != formula:
        raise InputError(f"formula {formula!r} cannot be read; write element symbols and numbers, such as C19H12O3")
    mass: dict[str, float] = {}
    for element, number in parts:
        mass[element] = mass.get(element, 0.0) + _atomic_weight(element) * float(number or 1)
    total = sum(mass.values())
    return Material(density=density, fractions={e: m / total for e, m in mass.items()})


@functools.cache
def table(name: str) -> tuple[tuple[str, ...], Array]:
    """(column names, values (rows, columns)) of a data file of the package."""
    text = resources.files("tomopose.simulation").joinpath("data", f"{name}.csv").read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    values = np.array([[float(x) for x in line.split(",")] for line in lines[1:]])
    values.setflags(write=False)
    return tuple(lines[0].split(",")), values


def xraydb() -> Any:
    """The module xraydb; EngineMissingError, with the line that installs it, where it is missing."""
    try:
        import xraydb as module
    except ImportError as error:
        raise EngineMissingError(
            "this element needs xraydb, which is not installed", install_line='pip install "tomopose[sim]"'
        ) from error
    return module


def _atomic_weight(element: str) -> float:
    if element in ATOMIC_WEIGHT:
        return ATOMIC_WEIGHT[element]
    try:
        return float(xraydb().atomic_mass(element))
    except ValueError as error:
        raise InputError(f"{element!r} is no chemical element") from error


def _mass_attenuation(element: str, energy: Array) -> Array:
    names, values = table("attenuation")
    grid = values[:, 0]
    if element in names[1:] and energy.size and energy.min() >= grid[0] and energy.max() <= grid[-1]:
        return np.exp(np.interp(np.log(energy), np.log(grid), np.log(values[:, names.index(element)])))
    try:
        return np.asarray(xraydb().mu_elam(element, energy * 1e3, kind="total"), dtype=np.float64)
    except ValueError as error:
        raise InputError(f"{element!r} is no chemical element") from error


MATERIALS: Mapping[str, Material] = MappingProxyType(
    {
        # Hard metal with 6 % cobalt binder, the usual grade of bearing balls (DIN 5401 leaves the grade open).
        "WC-Co": Material(density=14.9, fractions={"W": 0.94 * 0.9387, "C": 0.94 * 0.0613, "Co": 0.06}),
        "PEEK": from_formula("C19H12O3", 1.31),
        "Al": from_formula("Al", 2.699),
        "EN AW-6082": Material(density=2.70, fractions={"Al": 0.975, "Si": 0.010, "Mg": 0.009, "Mn": 0.006}),
        "ruby": from_formula("Al2O3", 3.98),
        "alumina": from_formula("Al2O3", 3.9),
        "Invar": Material(density=8.1, fractions={"Fe": 0.64, "Ni": 0.36}),
        "Cu": from_formula("Cu", 8.96),
        "Fe": from_formula("Fe", 7.874),
        "W": from_formula("W", 19.25),
        "CsI": from_formula("CsI", 4.51),
        "air": Material(density=0.001205, fractions={"N": 0.766, "O": 0.234}),
    }
)
"""Materials by name; a scene may define more."""


def known_material(material: Material | str, materials: Mapping[str, Material] = MATERIALS) -> Material:
    """The material of that name; InputError names those that are known."""
    if not isinstance(material, str):
        return material
    try:
        return materials[material]
    except KeyError:
        raise InputError(f"material {material!r} is unknown; known are {', '.join(sorted(materials))}") from None


def attenuation(material: Material | str, energy: ArrayLike, *, materials: Mapping[str, Material] = MATERIALS) -> Array:
    """Linear attenuation coefficient, 1/mm, at energies (n,), keV."""
    material = known_material(material, materials)
    energy = np.asarray(energy, dtype=np.float64)
    mu = sum(share * _mass_attenuation(element, energy) for element, share in material.fractions.items())
    return np.asarray(mu) * material.density * CM2_PER_G_TO_MM
