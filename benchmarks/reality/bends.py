"""What reality does: each bend changes a true world, or the data that come out of it, by a stated size."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from chain import World

DEG = np.pi / 180


@dataclass
class Data:
    """What the library is given: reported angles and positions, centres (n, 2) px, their stated sigma, px."""

    w: np.ndarray
    t: np.ndarray
    x: np.ndarray
    sigma: float


@dataclass(frozen=True)
class Bend:
    """names: words of which one must appear in the first explanation for the culprit to count as named."""

    name: str
    size: str
    world: Callable[[World, np.random.Generator, int], None] | None = None
    data: Callable[[Data, np.random.Generator], None] | None = None
    names: tuple[str, ...] = ()
    where: tuple[str, ...] = ("hexapod", "two balls", "robot", "moving")


def panel(name: str, key: str, values: list[tuple[str, float]], names: tuple[str, ...], where=None) -> list[Bend]:
    def change(v: float) -> Callable[[World, np.random.Generator, int], None]:
        def apply(world: World, rng: np.random.Generator, n: int) -> None:
            setattr(world.panel, key, getattr(world.panel, key) + v * rng.choice([-1.0, 1.0]))

        return apply

    more = {} if where is None else {"where": where}
    return [Bend(name, size, world=change(v), names=names, **more) for size, v in values]


def _world(name: str, names: tuple[str, ...], values, act, **more) -> list[Bend]:
    return [Bend(name, size, world=lambda w, rng, n, v=v: act(w, rng, n, v), names=names, **more) for size, v in values]


def _data(name: str, names: tuple[str, ...], values, act, **more) -> list[Bend]:
    return [Bend(name, size, data=lambda d, rng, v=v: act(d, rng, v), names=names, **more) for size, v in values]


def _unit(rng: np.random.Generator, n: int = 3) -> np.ndarray:
    v = rng.standard_normal(n)
    return v / np.linalg.norm(v)


def _both_pitches(w: World, rng, n, v) -> None:
    w.panel.p_u *= 1 + v
    w.panel.p_v *= 1 + v


def _tiles(w: World, rng, n, v) -> None:
    w.panel.tiles = v * rng.standard_normal((4, 4, 2))


def _set(target: str, key: str):
    def act(w: World, rng, n, v) -> None:
        setattr(getattr(w, target) if target else w, key, v(rng) if callable(v) else v)

    return act


def _wobble(w: World, rng, n, v) -> None:
    for k in (1, 2):
        for axis in range(3):
            w.table.shift.append((k, axis, v[0] * rng.standard_normal() / k, rng.uniform(0, 6.3)))
        for axis in range(2):
            w.table.tilt.append((k, axis, v[1] * rng.standard_normal() / k, rng.uniform(0, 6.3)))


def _bump(at):
    def act(w: World, rng, n, v) -> None:
        w.bump = (int(at * n) if at < 1 else n - int(at), _unit(rng) * v * 3e-3, _unit(rng) * v)

    return act


def _order(d: Data, rng, v) -> None:
    """The controller means R_z R_y R_x; the table is read as R_x R_y R_z (the truth keeps what was executed)."""
    from chain import turn

    R = turn(0, d.w[:, 0]) @ turn(1, d.w[:, 1]) @ turn(2, d.w[:, 2])
    y = -np.arcsin(np.clip(R[:, 2, 0], -1, 1))
    d.w = np.column_stack([np.arctan2(R[:, 2, 1], R[:, 2, 2]), y, np.arctan2(R[:, 1, 0], R[:, 0, 0])])


def _outliers(d: Data, rng, v) -> None:
    k = rng.choice(len(d.x), max(1, int(v * len(d.x))), replace=False)
    d.x[k] += rng.normal(0, 3.0, (len(k), 2))


def _closing(d: Data, rng, v) -> None:
    d.x[-1] += _unit(rng, 2) * v


def _sign(d: Data, rng, v) -> None:
    d.w = d.w * np.where(np.arange(3) == v, -1, 1)


TABLE = ("hexapod", "two balls")
BENDS: list[Bend] = [
    *panel(
        "roll", "eta", [("0.02 deg", 0.02 * DEG), ("0.05 deg", 0.05 * DEG), ("0.2 deg", 0.2 * DEG)], ("eta", "roll")
    ),
    *panel("tilt theta", "theta", [("0.05 deg", 0.05 * DEG), ("0.3 deg", 0.3 * DEG)], ("theta", "tilt")),
    *panel("tilt phi", "phi", [("0.05 deg", 0.05 * DEG), ("0.3 deg", 0.3 * DEG)], ("phi", "tilt")),
    *panel("d_SD", "d_SD", [("0.5 mm", 0.5), ("3 mm", 3.0)], ("d_SD", "pitch", "p_u", "p_v")),
    *panel("d_SR", "d_SR", [("0.05 mm", 0.05), ("0.5 mm", 0.5)], ("d_SR",), where=("hexapod", "two balls")),
    *panel("u_0", "u_0", [("0.3 px", 0.3), ("1.5 px", 1.5)], ("u_0", "axis")),
    *panel("v_0", "v_0", [("0.3 px", 0.3), ("1.5 px", 1.5)], ("v_0", "theta", "tilt")),
    *panel("pitch of u", "p_u", [("1e-4", 2e-5), ("1e-3", 2e-4)], ("p_u", "pitch")),
    *_world("both pitches", ("pitch", "p_u", "p_v", "d_SD"), [("5e-4", 5e-4)], _both_pitches),
    *_world("barrel", ("distortion",), [("0.1 px", 0.1), ("0.5 px", 0.5)], _set("panel", "barrel")),
    *_world("tiles", ("tile",), [("0.05 px", 0.05), ("0.3 px", 0.3)], _tiles),
    *_world(
        "axis offset",
        ("u_0", "axis", "phi"),
        [("0.05 mm", 0.05), ("0.3 mm", 0.3)],
        lambda w, rng, n, v: setattr(w.table, "offset", np.array([0.0, v, 0.0])),
        where=TABLE,
    ),
    *_world(
        "axis lean",
        ("axis", "eta", "roll", "theta", "tilt", "v_0"),
        [("0.3 mrad", 3e-4), ("2 mrad", 2e-3)],
        lambda w, rng, n, v: setattr(w.table, "lean", (v, -v / 2)),
        where=TABLE,
    ),
    *_world(
        "table wobble",
        ("table", "wobble"),
        [("0.3 um 1 urad", (3e-4, 1e-6)), ("3 um 20 urad", (3e-3, 2e-5))],
        _wobble,
        where=TABLE,
    ),
    *_world(
        "table encoder",
        ("table",),
        [("20 urad", 2e-5), ("200 urad", 2e-4)],
        lambda w, rng, n, v: w.table.encoder.append((2, v, rng.uniform(0, 6))),
        where=TABLE,
    ),
    *_world(
        "translation scale",
        ("translation", "scale", "d_SR", "d_SD"),
        [("2e-4", 2e-4), ("2e-3", 2e-3)],
        lambda w, rng, n, v: setattr(w.machine, "scale_t", 1 + v * np.ones(3)),
    ),
    *_world(
        "travel of z",
        ("translation", "scale", "p_v"),
        [("5e-4", 5e-4)],
        lambda w, rng, n, v: setattr(w.machine, "scale_t", np.array([1, 1, 1 + v])),
    ),
    *_world(
        "rotation scale",
        ("rotation", "scale"),
        [("2e-4", 2e-4), ("3e-3", 3e-3)],
        lambda w, rng, n, v: setattr(w.machine, "scale_w", 1 + v * np.ones(3)),
    ),
    *_world(
        "squareness",
        ("manipulator", "axes", "scale", "eta", "roll"),
        [("50 urad", 5e-5), ("1 mrad", 1e-3)],
        lambda w, rng, n, v: setattr(w.machine, "skew", v * np.triu(rng.choice([-1, 1], (3, 3)), 1)),
    ),
    *_world(
        "backlash",
        (),
        [("0.5 um 5 urad", (5e-4, 5e-6)), ("10 um 50 urad", (1e-2, 5e-5))],
        lambda w, rng, n, v: setattr(w.machine, "backlash", np.repeat(v, 3)),
    ),
    *_world(
        "periodic",
        (),
        [("0.5 um", (5e-4, 5e-6)), ("5 um", (5e-3, 5e-5))],
        lambda w, rng, n, v: setattr(
            w.machine, "periodic", [(k, v[k // 3], 3.1 if k < 3 else 0.03, rng.uniform(0, 6)) for k in range(6)]
        ),
    ),
    *_world(
        "scatter", (), [("0.5 um 12 urad", (5e-4, 12e-6)), ("3 um 40 urad", (3e-3, 4e-5))], _set("machine", "scatter")
    ),
    *_world(
        "spot drift",
        ("spot", "image", "drift"),
        [("1 um", 1e-3), ("20 um", 2e-2)],
        lambda w, rng, n, v: setattr(w, "spot_drift", v * np.array([0.8, 0.6, 0.0])),
    ),
    *_world(
        "image drift",
        ("spot", "image", "drift"),
        [("0.05 px", 0.05), ("0.5 px", 0.5)],
        lambda w, rng, n, v: setattr(w, "image_drift", v * _unit(rng, 2)),
    ),
    *_world(
        "ball drift",
        ("drift",),
        [("2 um", 2e-3), ("20 um", 2e-2)],
        lambda w, rng, n, v: setattr(w, "ball_drift", v * _unit(rng)),
    ),
    *_world(
        "slip",
        ("ball", "slip"),
        [("3 um", 3e-3), ("30 um", 3e-2)],
        lambda w, rng, n, v: setattr(w, "slip", (int(0.6 * n), v * _unit(rng))),
    ),
    *_world("bump at 40 %", ("mount", "moved", "jumped", "slipped"), [("5 um", 5e-3), ("100 um", 0.1)], _bump(0.4)),
    *_world("bump at 93 %", ("mount", "moved", "jumped", "slipped"), [("20 um", 2e-2), ("100 um", 0.1)], _bump(0.93)),
    *_world(
        "bump before the last 4", ("mount", "moved", "jumped", "slipped"), [("20 um", 2e-2), ("100 um", 0.1)], _bump(4)
    ),
    *_data(
        "closing pose", ("repeat", "again", "last", "closing", "set aside"), [("0.2 px", 0.2), ("2 px", 2.0)], _closing
    ),
    *_data("gross outliers", (), [("3 %", 0.03), ("8 %", 0.08)], _outliers),
    *_data("sigma understated", (), [("half", 0.5)], lambda d, rng, v: setattr(d, "sigma", v * d.sigma)),
    *_data("Euler order", ("order", "convention", "R_z"), [("reversed", 0)], _order),
    *_data("sign of rx", ("sign", "convention", "rx"), [("wrong", 0)], _sign),
    *_data("sign of rz", ("sign", "convention", "rz"), [("wrong", 2)], _sign),
]
