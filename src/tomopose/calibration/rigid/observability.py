"""What the poses can determine, in singular values and in words.

A direction counts as unobservable where its predicted standard uncertainty exceeds a size that no longer helps anybody
(`USELESS`), or where the scaled information matrix is singular within rounding.
"""

from __future__ import annotations

import functools

import numpy as np
import numpy.typing as npt

from tomopose.calibration.model.parameters import MATTERS, FreeParameters, base_name, unit_of
from tomopose.calibration.model.problem import Problem
from tomopose.calibration.model.tall import ByBall, is_tall, parts, triangle
from tomopose.calibration.rigid.fit import tangent_names
from tomopose.units import Array
from tomopose.values import value

USELESS_MM, USELESS_RAD, USELESS_FACTOR = 10.0, 0.1, 20.0
"""Standard uncertainties beyond which t_HT and t, R_HT, and (times `MATTERS`) a scanner parameter count as unknown."""

SINGULAR = 1e-7
"""Smallest singular value of the column-scaled Jacobian, relative to the largest, that still counts as information."""

NO_PART = 1e-3
"""A parameter whose error of the size that matters moves all centres together by less than this (in standard
deviations) plays no part."""

SHOWN = 0.25
"""A direction's words name the coordinates with at least this part of its largest component."""


@value
class Observability:
    """What the poses can determine.  singular_values of the scaled Jacobian, largest first; unobservable: directions,
    in words; notes: what would help."""

    singular_values: Array
    unobservable: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def condition(self) -> float:
        s = np.asarray(self.singular_values)
        return float(s[0] / s[-1]) if s.size and s[-1] > 0 else float("inf")


@functools.cache
def scales(names: tuple[str, ...]) -> Array:
    """(m,) natural size of each coordinate: 1 mm, 0.1 rad, or what matters of a scanner parameter."""
    return np.array(
        [
            0.1
            if n.startswith("w_HT")
            else 1.0
            if n.startswith("t") and base_name(n) not in MATTERS
            else MATTERS[base_name(n)]
            for n in names
        ]
    )


@functools.cache
def useless(names: tuple[str, ...]) -> Array:
    """(m,) standard uncertainty beyond which a coordinate counts as unknown."""
    return np.array(
        [
            USELESS_RAD
            if n.startswith("w_HT")
            else USELESS_FACTOR * MATTERS[base_name(n)]
            if base_name(n) in MATTERS
            else USELESS_MM
            for n in names
        ]
    )


def singular_values(J: Array) -> tuple[Array, Array]:
    """Singular values of the column-normalised Jacobian (k, m), largest first, and right vectors (m, m) by rows."""
    norm = np.linalg.norm(J, axis=0)
    # of many rows the triangle has the same, without the left vectors
    _, s, Vt = np.linalg.svd(np.linalg.qr(J / np.where(norm > 0, norm, 1.0), mode="r"), full_matrices=False)
    return s, Vt / np.where(norm > 0, norm, 1.0)


MOST_TERMS = 6
"""A direction of more coordinates than this is named by their groups: ten balls alone have thirty coordinates."""


def _group(name: str) -> str:
    if name.startswith("w_HT"):
        return "R_HT"
    if name.startswith("t_HT"):
        return "t_HT"
    return "the places of the balls" if name.startswith("t[") else "t" if name.startswith("t_") else base_name(name)


def _shown(names: tuple[str, ...], v: Array) -> npt.NDArray[np.int64]:
    """Places of the coordinates that name a direction."""
    size = np.abs(v) / scales(names)
    return np.flatnonzero(size >= SHOWN * size.max())


def _words(names: tuple[str, ...], v: Array) -> str:
    """A direction as "t_HT_x + 0.9 d_SR", or as the groups that move together where it has many coordinates."""
    terms = [(names[j], float(v[j])) for j in _shown(names, v)]
    if len(terms) > MOST_TERMS:
        groups = list(dict.fromkeys(_group(n) for n, _ in terms))
        return f"{', '.join(groups[:-1])} and {groups[-1]} together" if len(groups) > 1 else f"{groups[0]} together"
    unit = max(abs(x) for _, x in terms)
    return " ".join(f"{'-' if x < 0 else '+'} {abs(x) / unit:.2g} {n}" for n, x in terms).lstrip("+ ")


def unobservable_directions(J: Array, names: tuple[str, ...]) -> tuple[Array, list[Array]]:
    """(singular values, directions (m,)) that the whitened Jacobian J (k, m) cannot determine to any use."""
    s, V = singular_values(J)
    # v moved by one standard deviation changes the coordinates by v / s_k
    far = (np.abs(V) > s[:, None] * useless(names)).any(axis=1)
    bad = list(V[(s <= SINGULAR * s[0]) | far])
    silent = [np.eye(len(names))[j] for j in np.flatnonzero(~J.any(axis=0))]
    return s, bad + silent


def direction_and_remedy(problem: Problem, names: tuple[str, ...], v: Array) -> tuple[str, str]:
    """(direction in words, what would fix it)."""
    words = _words(names, v)
    main = {base_name(names[j]) for j in _shown(names, v)}
    scanner_names = main & MATTERS.keys()
    if scanner_names and np.ptp(problem.alpha) == 0.0:
        return (
            f"{words}: exactly or nearly degenerate while the table stays at one angle",
            "add poses at another table angle, or give a prior standard deviation",
        )
    if "translation_scale" in scanner_names:
        return f"{words}: only the ratio of lengths is visible", "give a prior on translation_scale or on d_SR"
    if scanner_names:
        return f"{words}: these poses cannot distinguish them", "add compound rotations, table angles, or a prior"
    ball = [j for j, n in enumerate(names) if n.startswith(("t_x", "t_y", "t_z", "t["))]
    moved = v[ball].reshape(-1, 3)
    if len(moved) and np.abs(moved).max() >= SHOWN * np.abs(v / scales(names)).max():
        axis = moved[np.abs(moved).max(axis=1).argmax()]
        axis = np.round(axis / np.linalg.norm(axis) * (np.sign(axis[np.abs(axis).argmax()]) or 1.0), 2) + 0.0
        where = f"({axis[0]:.2f}, {axis[1]:.2f}, {axis[2]:.2f})"
        if np.abs(problem.R_MH @ problem.R_MH[0].T - np.eye(3)).max() <= 1e-9:
            return (
                f"t_HT and t cannot be distinguished ({words}): no pose rotates the moved plate",
                "add poses rotated about two different axes",
            )
        return (
            f"t_HT and t cannot be distinguished along the direction {where} of the moved plate ({words}): the "
            "poses turn about that axis only",
            "add poses rotated about another axis",
        )
    return f"{words} cannot be determined from these poses", "add translations and rotations in other directions"


def assumed_report(problem: Problem, J_assumed: Array, J: Array, names: tuple[str, ...]) -> tuple[str, ...]:
    """Sentences on the scanner parameters that were assumed: could these data have determined them?

    J (k, m) whitened Jacobian of the estimated coordinates, J_assumed (k, a) of the assumed ones `names`.
    """
    Q, _ = np.linalg.qr(J)
    left = J_assumed - Q @ (Q.T @ J_assumed)
    norm, before = np.linalg.norm(left, axis=0), np.linalg.norm(J_assumed, axis=0)
    sentences = []
    for name, after, raw in zip(names, norm, before, strict=True):
        if raw * MATTERS[name] < NO_PART:
            continue
        if after <= 1e-9 * raw:
            sentences.append(f"{name} is assumed: an error of it is absorbed without a trace by the mount")
        elif 1.0 / after > MATTERS[name]:
            unit = unit_of(name)
            sentences.append(
                f"{name} is assumed: these poses would show it only to {1.0 / after:.2g}{' ' + unit if unit else ''}, "
                f"worse than the {MATTERS[name]:g}{' ' + unit if unit else ''} that matter"
            )
    return tuple(sentences)


def whitened_columns(problem: Problem, *J: Array | ByBall) -> Array:
    """(k, m): derivatives (n, 2, m_i) px in standard deviations, side by side; of very many rows, vectors with the same
    inner products."""

    def rows(part: slice) -> Array:
        W = problem.W[part]
        white = [(W @ A[part]).reshape(2 * len(W), A.shape[2]) for A in J]
        return white[0] if len(white) == 1 else np.concatenate(white, axis=1)

    n = len(problem)
    return triangle(rows(p) for p in parts(n)) if is_tall(2 * n) else rows(slice(0, n))


def observability(
    problem: Problem, free: FreeParameters, J: Array | ByBall, J_assumed: Array, assumed: tuple[str, ...]
) -> Observability:
    """The report of a fit; J (n, 2, m) and J_assumed (n, 2, a) in px, without priors."""
    names = tangent_names(problem.ball_ids, free)
    whitened = whitened_columns(problem, J, J_assumed)
    s, bad = unobservable_directions(whitened[:, : len(names)], names)
    pairs = [direction_and_remedy(problem, names, v) for v in bad]
    notes = assumed_report(problem, whitened[:, len(names) :], whitened[:, : len(names)], assumed)
    return Observability(
        singular_values=s,
        unobservable=tuple(w for w, _ in pairs),
        notes=tuple(dict.fromkeys([*(c for _, c in pairs), *notes])),
    )
