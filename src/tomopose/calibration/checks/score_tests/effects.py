"""What could be so: effects on the projected centres, as columns of a linear model, and their words.

All columns are whitened; a size is in the unit that the words name.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from tomopose.calibration.model.ball_projection import SCANNER_COLUMNS, ProjectionBlocks
from tomopose.calibration.model.problem import Problem, elapsed
from tomopose.calibration.model.unseen import turns
from tomopose.geometry.extent import largest_distance
from tomopose.geometry.rotations import skew
from tomopose.units import Array

DRIFT_ORDER = 3
TILES = 4
FEW_ANGLES, MANY_ANGLES = 3, 12
"""Table angles that must differ before harmonics are asked for; from the second number on two harmonics are."""

AS_NAMED = 0.05
"""Part of a size that an effect may have by which the estimate may differ: other small effects pull at it."""

Words = Callable[[Array, float, str], str]


@dataclass(frozen=True, kw_only=True)
class Effect:
    """name: fixed;  kind: scanner | panel | manipulator | table | time | step | convention;  short: a few words;  odds:
    log of its prior odds against the others;  sizes: the only ones that it may have (of either sign), or any;  words:
    (size, px, pose id) -> the sentence."""

    name: str
    kind: str
    short: str
    words: Words
    odds: float = 0.0
    sizes: tuple[float, ...] = ()

    def may_be(self, size: float, sigma: float) -> bool:
        """Whether a size with that standard uncertainty is one of those that the effect may have."""
        return not self.sizes or any(abs(abs(size) - s) < max(3.0 * sigma, AS_NAMED * s) for s in self.sizes)

    def words_of(self, size: Array, px: float, at: str, *, short: bool = False) -> str:
        return self.short if short else f"{self.words(size, px, at)} ({px:.2g} px rms)"


@dataclass(frozen=True, kw_only=True)
class Columns:
    """px: of some rows (k of n), the columns (k, 2, c) px of an effect;  constant: how many of them, the first, are no
    part of the effect but must be free beside it."""

    effect: Effect
    px: Callable[[slice], Array]
    constant: int = 0


def white_columns(problem: Problem, columns: Sequence[Columns], rows: slice = slice(None)) -> list[Array]:
    """(2 k, c) each: whitened columns of effects in some rows, views of one array."""
    each = [c.px(rows) for c in columns]
    white = problem.W[rows] @ np.concatenate(each, axis=2)
    flat = white.reshape(2 * len(white), -1)
    ends = np.cumsum([c.shape[2] for c in each])
    return [flat[:, end - c.shape[2] : end] for c, end in zip(each, ends, strict=True)]


@dataclass(frozen=True, kw_only=True)
class Steps:
    """C (n, 2, c): whitened columns of something that may change at any pose; at least `least` poses on each side."""

    effect: Effect
    C: Array
    least: int


SCANNER_WORDS = {
    "eta": ("the panel is rolled about the beam (eta) by {:+.3g} mrad", 1e3, "roll of the panel (eta)"),
    "theta": ("the panel is tilted about its rows (theta) by {:+.3g} mrad", 1e3, "tilt theta"),
    "phi": ("the panel is tilted about its columns (phi) by {:+.3g} mrad", 1e3, "tilt phi"),
    "d_SD": ("d_SD is off by {:+.3g} mm", 1.0, "d_SD"),
    "d_SR": ("d_SR is off by {:+.3g} mm", 1.0, "d_SR"),
    "u_0": ("u_0 is off by {:+.3g} px", 1.0, "u_0"),
    "v_0": ("v_0 is off by {:+.3g} px", 1.0, "v_0"),
    "p_u": ("the pixel pitch p_u is off by {:+.3g} um", 1e3, "pitch p_u"),
    "p_v": ("the pixel pitch p_v is off by {:+.3g} um", 1e3, "pitch p_v"),
    "axis_y": ("the table axis passes W by {:+.3g} um (axis_y)", 1e3, "offset of the table axis (axis_y)"),
    "axis_tilt_x": (
        "the table axis is tilted (axis_tilt_x) by {:+.3g} mrad",
        1e3,
        "tilt of the table axis (axis_tilt_x)",
    ),
    "axis_tilt_y": (
        "the table axis is tilted (axis_tilt_y) by {:+.3g} mrad",
        1e3,
        "tilt of the table axis (axis_tilt_y)",
    ),
    "translation_scale": ("the manipulator's translations have the scale 1 {:+.3g}", 1.0, "translation scale"),
}


ORIGIN_ODDS = -2.0
"""Where v_0 does not show, an origin of the pixels and u_0 explain the same: u_0 is named first, the origin beside."""

AXIS_ODDS = -1.0
"""A tilt of the table axis about the beam and a roll of the panel are the same to the images: the panel's is named."""


def scanner_effect(name: str) -> Effect:
    text, factor, short = SCANNER_WORDS[name]
    kind = "manipulator" if name == "translation_scale" else "scanner"
    return Effect(
        name=name,
        kind=kind,
        short=short,
        words=lambda size, px, at: text.format(float(size[0]) * factor),
        odds=AXIS_ODDS if name.startswith("axis") else 0.0,
    )


def _fixed(name: str, kind: str, short: str, text: str | None = None) -> Effect:
    sentence = short if text is None else text
    return Effect(name=name, kind=kind, short=short, words=lambda size, px, at: sentence)


def _length(name: str, kind: str, short: str, text: str, factor: float, order: int) -> Effect:
    """A drift: its reach is the largest distance between two moments of the run."""

    def words(size: Array, px: float, at: str) -> str:
        course = np.polynomial.legendre.legvander(np.linspace(-1, 1, 40), order)
        path = course @ size.reshape(order + 1, -1)
        return text.format(largest_distance(path) * factor)

    return Effect(name=name, kind=kind, short=short, words=words)


def effects_of(problem: Problem, b: ProjectionBlocks) -> list[Columns]:
    """All effects without a place: scanner, panel, manipulator, table, time."""
    found = [_scanner_columns(b, k, name) for k, name in enumerate(SCANNER_COLUMNS)]
    found += _panel(problem, b)
    found += _manipulator(problem, b)
    found += _table(problem, b)
    if len(problem) > 2 * DRIFT_ORDER:
        found += _drifts(problem, b)
    return found


def _scanner_columns(b: ProjectionBlocks, k: int, name: str) -> Columns:
    return Columns(effect=scanner_effect(name), px=lambda rows: b.J_scanner[rows, :, k : k + 1])


def pixel_origin(problem: Problem) -> Columns:
    """Pixels counted from a corner or from 1: u and v are off alike, by half a pixel or a whole one."""
    effect = Effect(
        name="pixel origin",
        kind="convention",
        short="pixels counted from another origin (corner, or 1)",
        words=lambda size, px, at: (
            f"u and v are both off by {float(size[0]):+.2f} px: pixels are counted from another origin (a corner, or 1)"
        ),
        odds=ORIGIN_ODDS,
        sizes=(0.5, 1.0),
    )
    return Columns(effect=effect, px=lambda rows: np.ones((len(problem.alpha[rows]), 2, 1)))


def _panel(problem: Problem, b: ProjectionBlocks) -> list[Columns]:
    s = problem.scanner
    size = np.array([s.n_u, s.n_v], dtype=np.float64)
    middle = (size - 1) / 2
    q = (b.x_D - middle) / np.linalg.norm(middle)
    radial = q * (q * q).sum(axis=1, keepdims=True)
    found = [
        Columns(
            effect=Effect(
                name="radial distortion",
                kind="panel",
                short="radial distortion of the panel",
                words=lambda size, px, at: (
                    f"the panel shows a radial distortion of {float(size[0]):+.2g} px at its corners"
                ),
            ),
            px=lambda rows: radial[rows, :, None],
        )
    ]
    cell = np.clip((b.x_D / size * TILES).astype(int), 0, TILES - 1) @ [1, TILES]
    hit = [k for k in np.unique(cell) if (cell == k).sum() >= 4]
    if len(hit) > 2:
        place = np.searchsorted(hit, cell)
        on = np.isin(cell, hit)

        def tiles(rows: slice) -> Array:
            k, where, shown = np.arange(len(cell[rows])), place[rows], on[rows]
            C = np.zeros((len(k), 2, 2 * len(hit)))
            for e in (0, 1):
                C[k[shown], e, 2 * where[shown] + e] = 1.0
            return C

        found.append(
            Columns(
                effect=_fixed(
                    "tile map", "panel", "displaced tiles of the panel", "the panel's parts (tiles) are displaced"
                ),
                px=tiles,
            )
        )
    return found


def _axis_scale(b: ProjectionBlocks, t: Array, i: int) -> Callable[[slice], Array]:
    """Columns of a scale of the translations t (n, 3) along the axis i."""
    return lambda rows: (b.G_H[rows, :, i] * t[rows, i, None])[:, :, None]


def _scale_words(c: str) -> Words:
    """The words of a translation scale along the axis c."""
    return lambda size, px, at: f"the manipulator's {c} has the translation scale 1 {float(size[0]):+.2g}"


def _manipulator(problem: Problem, b: ProjectionBlocks) -> list[Columns]:
    t = problem.t_MH
    found = [
        Columns(
            effect=Effect(
                name=f"scale of {c}",
                kind="manipulator",
                short=f"translation scale of {c}",
                words=_scale_words(c),
            ),
            px=_axis_scale(b, t, i),
        )
        for i, c in enumerate("xyz")
    ]
    pairs = [(i, j) for i in range(3) for j in range(3) if i != j]
    found.append(
        Columns(
            effect=_fixed("axes", "manipulator", "axes of the manipulator not square or not parallel"),
            px=lambda rows: np.stack([b.G_H[rows, :, i] * t[rows, j, None] for i, j in pairs], axis=2),
        )
    )
    w = turns(b.R_MH)
    found.append(
        Columns(
            effect=Effect(
                name="rotation scale",
                kind="manipulator",
                short="rotation scale",
                words=lambda size, px, at: (
                    "the manipulator's rotation scale is 1 "
                    + ", ".join(f"{float(s):+.2g}" for s in size)
                    + " about x, y, z"
                ),
            ),
            px=lambda rows: (-b.G_H[rows] @ skew(b.x_H[rows] - t[rows])) * w[rows, None, :],
        )
    )
    return found


def _table(problem: Problem, b: ProjectionBlocks) -> list[Columns]:
    """Errors of the table's angle and axis, by harmonics of it; by the angle where few of them differ."""
    alpha = problem.alpha
    angles, which = np.unique(np.round(alpha, 9), return_inverse=True)
    if len(angles) < 2:
        return []
    # dx_T by a turn about the axis, as the images see it: R_z x_T moves along e_z x x_T
    y_T = np.einsum("nij,nj->ni", _mount(b), b.x_H)
    by_angle = (b.J_t_HT @ np.cross([0.0, 0.0, 1.0], y_T)[:, :, None])[..., 0]
    if len(angles) > FEW_ANGLES:
        orders = (1, 2) if len(angles) >= MANY_ANGLES else (1,)
        waves = np.column_stack([f(k * alpha) for k in orders for f in (np.sin, np.cos)])
    else:
        waves = np.eye(len(angles))[which][:, 1:]
    found = [
        Columns(
            effect=_fixed("table angle", "table", "errors of the table's angle"),
            px=lambda rows: by_angle[rows, :, None] * waves[rows, None, :],
        )
    ]
    if len(angles) > FEW_ANGLES:
        wobble = _fixed("table wobble", "table", "wobble of the table")
        found.append(Columns(effect=wobble, px=lambda rows: _products(b.J_t_HT[rows], waves[rows])))
    return found


def _products(D: Array, course: Array) -> Array:
    """(k, 2, a b): each of the columns D (k, 2, a) times each course (k, b), by `a` first."""
    return np.asarray((D[:, :, :, None] * course[:, None, None, :]).reshape(len(D), 2, -1))


def _mount(b: ProjectionBlocks) -> Array:
    """(n, 3, 3) R_HT, from dx/dx_H = dx/dx_T R_HT and dx/dw_HT; the same for all poses."""
    A = b.J_t_HT.reshape(-1, 3)
    R = np.linalg.lstsq(A, b.G_H.reshape(-1, 3), rcond=None)[0]
    return np.broadcast_to(R, (len(b.x_H), 3, 3))


def _drifts(problem: Problem, b: ProjectionBlocks) -> list[Columns]:
    """About a constant that is free: nobody knows at which moment of the run the values of the scanner hold."""
    tau = elapsed(problem)
    course = np.polynomial.legendre.legvander(2.0 * tau / np.ptp(tau) - 1.0, DRIFT_ORDER)
    found = []
    image = np.broadcast_to(np.eye(2), (len(problem), 2, 2))
    for order, ending in ((1, "linear"), (DRIFT_ORDER, "curved")):
        for name, short, text, factor, base in (
            (
                "image drift",
                "drift of the focal spot or the images",
                "the images drift by {:.2g} px over the run (focal spot or detector)",
                1.0,
                image,
            ),
            ("ball drift", "drift of the ball", "the ball drifts by {:.2g} um over the run", 1000.0, b.J_t_HT),
        ):
            effect = _length(name if order > 1 else f"{name}, {ending}", "time", short, text, factor, order)
            px = _over_time(base, np.asarray(course[:, : order + 1], dtype=np.float64))
            found.append(Columns(effect=effect, px=px, constant=base.shape[2]))
    return found


def _over_time(base: Array, course: Array) -> Callable[[slice], Array]:
    """Columns of base (n, 2, c) that follow the courses (n, k), by course first."""
    return lambda rows: (base[rows][:, :, None, :] * course[rows][:, None, :, None]).reshape(
        len(course[rows]), 2, base.shape[2] * course.shape[1]
    )


IMAGE_STEP_ODDS = -8.0
"""A bump or a slip is likelier than a jump of spot or detector, which has fewer parameters and would else win wherever
few poses come after the step."""


PIVOT_STEP_ODDS = -2.0
"""A pivot is changed by hand; a ball that slips, which looks alike where the poses hardly turn, is likelier."""


def _step_effect(name: str, short: str, text: str, part: slice, factor: float, unit: str, odds: float = 0.0) -> Effect:
    def words(size: Array, px: float, at: str) -> str:
        return f"{text} at pose {at}, by {np.linalg.norm(size[part]) * factor:.2g} {unit}"

    return Effect(name=name, kind="step", short=short, words=words, odds=odds)


def steps_of(problem: Problem, b: ProjectionBlocks) -> list[Steps]:
    """What may change from one pose to the next: the ball, the mount, the pivot, the images."""
    n = len(problem)
    J_mount = problem.W @ b.J_mount
    return [
        Steps(
            effect=_step_effect(
                "ball step", "the ball slipped", "the ball changed its place (slipped)", slice(0, 3), 1000.0, "um"
            ),
            C=problem.W @ b.J_t,
            least=2,
        ),
        Steps(
            effect=_step_effect(
                "mount step",
                "the mount moved",
                "the mount changed (bumped or referenced anew)",
                slice(3, 6),
                1000.0,
                "um",
            ),
            C=J_mount,
            least=3,
        ),
        Steps(
            effect=_step_effect(
                "pivot step",
                "the pivot of the controller changed",
                "the pivot of the controller changed",
                slice(0, 3),
                1000.0,
                "um",
                PIVOT_STEP_ODDS,
            ),
            # a pivot off by c shifts H against the base and M against the plate: t_HT += R_HT c, t -= c
            C=problem.W @ (b.J_t_HT @ _mount(b) - b.J_t),
            least=2,
        ),
        Steps(
            effect=_step_effect(
                "image step",
                "the images jumped",
                "the images changed their place (jumped: focal spot or detector)",
                slice(0, 2),
                1.0,
                "px",
                IMAGE_STEP_ODDS,
            ),
            C=np.array(np.broadcast_to(problem.W @ np.eye(2), (n, 2, 2))),
            least=2,
        ),
    ]
