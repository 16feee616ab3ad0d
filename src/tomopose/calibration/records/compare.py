"""Has the mount changed between two calibrations?  The questions of the paper's table 2, with their significance."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.special import chdtrc

from tomopose.calibration.records.setup import held_scanner, scanner_changes
from tomopose.calibration.result import Calibration
from tomopose.errors import InputError
from tomopose.geometry.rotations import log_rotation
from tomopose.manipulator.poses import PIVOT_TOLERANCE_MM
from tomopose.units import Array
from tomopose.values import require_types, value

SIGNIFICANT = 0.01
NOT_TESTED = (float("nan"), float("nan"))
MOUNT = tuple(f"{what}_HT_{c}" for what in "wt" for c in "xyz")


@value
class Comparison:
    """b minus a.

    names:       coordinates that both calibrations have (w_HT: rotation vector of R_b R_a^T, rad; others mm, px ...).
    difference, u, z: (m,) the change, its standard uncertainty, and their ratio.
    p:           (m,) probability of a change of at least this size by chance.
    chi2_mount, p_mount: of the six coordinates of T_HT together;  chi2_all, p_all: of all.
    words:       one sentence a finding.
    scanner:     scanner values that differ, "d_SR_mm 283.5 -> 284".  T_HT is then another quantity: the mount is not
                 tested, chi2_mount and the probabilities are NaN.
    """

    names: tuple[str, ...]
    difference: Array
    u: Array
    z: Array
    p: Array
    chi2_mount: float
    p_mount: float
    chi2_all: float
    p_all: float
    words: tuple[str, ...]
    scanner: tuple[str, ...] = ()

    @property
    def mount_changed(self) -> bool:
        return self.p_mount < SIGNIFICANT

    @property
    def changed(self) -> bool:
        """Whether anything changed: scanner.json, the mount, the ball or an estimated scanner value."""
        return bool(self.scanner) or self.mount_changed or self.p_all < SIGNIFICANT

    def to_json(self) -> dict[str, Any]:
        return {
            "names": list(self.names),
            "difference": self.difference.tolist(),
            "u": self.u.tolist(),
            "z": self.z.tolist(),
            "p": self.p.tolist(),
            "chi2_mount": self.chi2_mount,
            "p_mount": self.p_mount,
            "chi2_all": self.chi2_all,
            "p_all": self.p_all,
            "words": list(self.words),
            "scanner_changes": list(self.scanner),
            "changed": self.changed,
        }


def _two_sided(z: Array) -> Array:
    return np.asarray(chdtrc(1, z**2), dtype=np.float64)


def _together(d: Array, C: Array) -> tuple[float, float]:
    s = np.sqrt(np.diag(C))
    chi2 = float((d / s) @ np.linalg.lstsq(C / s[:, None] / s, d / s, rcond=1e-12)[0])
    return chi2, float(chdtrc(len(d), chi2))


@require_types
def compare(a: Calibration, b: Calibration) -> Comparison:
    """The change from calibration a to calibration b, taken as independent: C_a + C_b.

    Both must have the same pivot, or H itself differs: InputError.
    """
    if a.pivot is not None and b.pivot is not None and np.abs(a.pivot - b.pivot).max() > PIVOT_TOLERANCE_MM:
        raise InputError(f"the calibrations have different pivots, {a.pivot} and {b.pivot} mm: their H is not the same")
    names = tuple(n for n in a.tangent if n in b.tangent)
    i, j = [a.tangent.index(n) for n in names], [b.tangent.index(n) for n in names]
    C = a.covariance[np.ix_(i, i)] + b.covariance[np.ix_(j, j)]
    # w of b is taken about R_a: to first order in the change the coordinates are the same
    change = {f"w_HT_{c}": w for c, w in zip("xyz", log_rotation(b.T_HT.R @ a.T_HT.R.T), strict=True)}
    values_a, values_b = ({p.name: p.value for p in c.parameters} for c in (a, b))
    d = np.array([change[n] if n in change else values_b[n] - values_a[n] for n in names])
    u = np.sqrt(np.diag(C))
    z = d / u
    mount = [k for k, n in enumerate(names) if n in MOUNT]
    scanner = scanner_changes(held_scanner(a), held_scanner(b))
    (chi2_mount, p_mount), (chi2_all, p_all) = (
        (NOT_TESTED, NOT_TESTED) if scanner else (_together(d[mount], C[np.ix_(mount, mount)]), _together(d, C))
    )
    p = np.full(len(d), np.nan) if scanner else _two_sided(z)
    return Comparison(
        names=names,
        difference=d,
        u=u,
        z=z,
        p=p,
        chi2_mount=chi2_mount,
        p_mount=p_mount,
        chi2_all=chi2_all,
        p_all=p_all,
        words=_words(a, b, names, z, p_mount, p_all, scanner),
        scanner=scanner,
    )


def _words(
    a: Calibration,
    b: Calibration,
    names: tuple[str, ...],
    z: Array,
    p_mount: float,
    p_all: float,
    scanner: tuple[str, ...],
) -> tuple[str, ...]:
    if scanner:
        words = [
            f"scanner.json changed: {'; '.join(scanner)}. T_HT depends on these values, so the mount is not tested; "
            "calibrate both runs with one scanner.json to compare them"
        ]
    else:
        changed = "changed significantly" if p_mount < SIGNIFICANT else "did not change significantly"
        words = [f"the mount T_HT {changed} (p = {p_mount:.2g})"]
    if p_mount >= SIGNIFICANT > p_all:
        words.append(f"the ball or the scanner's values changed (p = {p_all:.2g})")
    largest = int(np.abs(z).argmax())
    if not scanner:
        words.append(f"the largest change is {names[largest]}, {abs(z[largest]):.1f} standard uncertainties")
    only = set(a.tangent) ^ set(b.tangent)
    if only:
        words.append(f"not in both and not compared: {', '.join(sorted(only))}")
    if a.verdict != "trustworthy" or b.verdict != "trustworthy":
        words.append("one of the calibrations is not trustworthy; so is this comparison")
    return tuple(words)
