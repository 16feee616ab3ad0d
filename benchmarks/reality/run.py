"""Where the uncertainty holds and where it does not.  python benchmarks/reality/run.py [--quick] [--only W] [--list]

Bends reality in known ways (bends.py) over three plans and several arrangements, calibrates, and compares the true
error of a scan, as a volume sees it, with what the calibration states.  The truth comes from chain.py, which shares
nothing with the library.  Noise 0.0146 px a coordinate (the paper's d_rms 0.0207 px), magnification 5.3.
"""

from __future__ import annotations

import argparse
import json
import time
import zlib
from collections import defaultdict
from dataclasses import dataclass

import numpy as np
import plans
from bends import BENDS, Bend, Data
from chain import World, intrinsic_xyz

import tomopose as tp
from tomopose.calibration.rigid.pose_noise import scatter_prior
from tomopose.manipulator.real_poses import Repeatability

NOISE = 0.0146
PLATFORM_SCALE, ROBOT_SCALE, PLATFORM_ROTATION_SCALE = 5e-5, 1e-3, 1.3e-4
"""Documented defaults for the scale of a manipulator's translations and of a platform's rotations, where nothing is
stated of the scanner."""
AXIS_MM, AXIS_RAD = 0.02, 2e-4
"""Documented defaults for where the table's axis is."""
FLOOR = 0.002
"""px: below it a true error is noise of the benchmark, whatever its ratio to the stated one."""
ASSUMED = "uncertainty with all that is assumed"
"""Rule: the uncertainty of a scan, with what was assumed, is above a pixel."""
ARRANGEMENTS = ("hexapod", "two balls", "robot", "moving")
SIZES = {
    "d_SD": 0.5,
    "d_SR": 0.1,
    "u_0": 1.0,
    "v_0": 1.0,
    "eta": 1e-3,
    "theta": 1e-3,
    "phi": 1e-3,
    "p_u": 2e-5,
    "p_v": 2e-5,
}


@dataclass
class Outcome:
    plan: str
    where: str
    bend: str
    size: str
    verdict: str
    true: float
    stated: float
    shared: float
    named: bool | None
    first: str
    ms: float
    shift: dict[str, float]

    @property
    def ratio(self) -> float:
        return self.true / self.stated if self.stated > 0 else np.inf


def declared(world: World, sigma: dict[str, float]) -> tp.Scanner:
    p = world.panel
    return tp.Scanner(
        d_SD=p.d_SD, d_SR=p.d_SR, p_u=p.p_u, p_v=p.p_v, u_0=p.u_0, v_0=p.v_0, n_u=p.n_u, n_v=p.n_v, sigma=sigma
    )


def sequence(p: plans.Poses, w: np.ndarray, t: np.ndarray) -> tp.PoseSequence:
    from tomopose.geometry.frames import Frame

    return tp.PoseSequence(
        T_MH=tp.RigidTransform(R=intrinsic_xyz(w), t=t, source=Frame.M, target=Frame.H),
        pose_id=tuple(str(i) for i in range(len(p))),
        alpha=p.alpha,
        ball_id=p.ball,
    )


def plan_of(name: str, where: str, rng: np.random.Generator) -> plans.Poses:
    if where in ("robot", "moving"):
        return plans.robot(rng, {"paper": 189, "two angles": 90, "small": 40}[name])
    poses = {"paper": plans.paper, "two angles": plans.two_angles}.get(name, lambda: plans.small(rng))()
    if where == "two balls":
        poses.ball = np.arange(len(poses)) % 2
        poses.ball[-1] = poses.ball[0]
    return poses


def one(plan: str, where: str, bend: Bend | None, seed: int, *, sigma: dict[str, float], draw: bool = False) -> Outcome:
    """One calibration: a world, bent; data; what the library says; what is true.

    draw: everything that a calibration assumes is drawn.
    """
    rng = np.random.default_rng([seed, zlib.crc32(f"{plan}{where}{bend and bend.name}{bend and bend.size}".encode())])
    world, balls = plans.world(where, rng)
    scanner = declared(world, sigma)
    poses = plan_of(plan, where, rng)
    if draw:
        # a scanner that moves as a whole takes a roll and the origin of W into its mount: they shift t_HT, no scan
        sizes = {k: s for k, s in assumed_sizes(scanner).items() if where != "moving" or k not in ("d_SR", "eta")}
        for key, s in sizes.items():
            setattr(world.panel, key, getattr(world.panel, key) + s * rng.standard_normal())
        if where != "moving":
            world.table.offset = np.array([0.0, AXIS_MM * rng.standard_normal(), 0.0])
            world.table.lean = tuple(AXIS_RAD * rng.standard_normal(2))
        scale = ROBOT_SCALE if where in ("robot", "moving") else PLATFORM_SCALE
        world.machine.scale_t = 1.0 + scale * rng.standard_normal() * np.ones(3)
        if where not in ("robot", "moving"):
            world.machine.scale_w = 1.0 + PLATFORM_ROTATION_SCALE * rng.standard_normal(3)
        world.machine.scatter = drawn_scatter(rng)
    if bend and bend.world:
        bend.world(world, rng, len(poses))
    x = world.image(poses.w, poses.t, poses.alpha, balls[poses.ball][:, None], rng, run=True)[:, 0]
    data = Data(poses.w.copy(), poses.t.copy(), x + NOISE * rng.standard_normal(x.shape), NOISE)
    if bend and bend.data:
        bend.data(data, rng)
    observed = tp.BallObservations.from_sigma(data.x, data.sigma, pose_id=[str(i) for i in range(len(poses))])
    logged = sequence(poses, data.w, data.t)
    scan = plans.robot_scan() if where in ("robot", "moving") else plans.hexapod_scan()
    # the scan runs after the calibration: a slipped ball is of no meaning, a bumped mount stays bumped
    if world.bump is not None:
        world.t_HT = world.t_HT + world.bump[2]
        from chain import small_turn

        world.R_HT = small_turn(world.bump[1]) @ world.R_HT
        world.bump = None
    begin = time.process_time()
    known = () if draw or bend else ("translation_scale",)
    cal, words = _calibrate(where, scanner, logged, observed, known)
    ms = 1000 * (time.process_time() - begin)
    if cal is None:
        return Outcome(
            plan,
            where,
            bend.name if bend else "clean",
            bend.size if bend else "",
            "refused",
            np.nan,
            np.nan,
            np.nan,
            None,
            words,
            ms,
            {},
        )
    x_W = plans.points_in_view(world.panel)
    x_M = (x_W - world.t_HT) @ world.R_HT
    target = world.image(scan.w, scan.t, scan.alpha, x_M, rng, run=False)
    executed = sequence(scan, scan.w, scan.t)
    P = tp.projection_matrices(cal, tp.inverse_poses(executed) if where == "moving" else executed, points=x_W)
    stated = float(np.sqrt(np.mean(P.points_sigma**2)))
    shared = float(np.sqrt(np.mean(P.points_sigma_shared**2)))
    true = plans.scan_error(P.P, target, x_W)
    first = words[0] if words else ""
    named = None if bend is None or not bend.names else any(w in first for w in bend.names)
    truth = {"t_HT_x": world.t_HT[0], "t_HT_y": world.t_HT[1], "t_HT_z": world.t_HT[2]}
    shift = {p.name: (p.value - truth[p.name]) / p.u for p in cal.parameters if p.name in truth and p.u > 0}
    return Outcome(
        plan,
        where,
        bend.name if bend else "clean",
        bend.size if bend else "",
        cal.verdict,
        true,
        stated,
        shared,
        named,
        first,
        ms,
        shift,
    )


def drawn_scatter(rng: np.random.Generator) -> tuple[float, float]:
    """Scatter of the poses, mm and rad, from the prior that a calibration assumes of a platform."""
    q = np.geomspace(1e-4, 10.0, 4000)
    share = np.cumsum(scatter_prior(q) * np.gradient(q))
    maker = Repeatability()
    t, w = np.interp(rng.random(2) * share[-1], share, q)
    return float(t * maker.t_mm), float(w * maker.w_rad)


def assumed_sizes(scanner: tp.Scanner) -> dict[str, float]:
    """Standard deviations that a calibration assumes of the panel, by name; those of SIZES where it assumes none."""
    try:
        from tomopose.calibration.model.assumed import assumed_of
    except ImportError:
        return SIZES
    return {a.name: a.sigma for a in assumed_of(scanner) if a.name in SIZES}


def _calibrate(where, scanner, logged, observed, known):
    try:
        if where == "moving":
            cal = tp.calibrate_inverse(scanner, logged, observed, fix=known)
        else:
            cal = tp.calibrate(scanner, logged, observed, fix=known)
    except tp.errors.TomoposeError as error:
        return None, str(error)
    explained = [e.words for e in cal.explanations]
    # how uncertain the assumed values make a scan is said of every run alike, and names no culprit
    checks = [f for f in cal.checks if f.rule not in ("degrees of freedom", ASSUMED)]
    reasons = [f.words for f in checks if f.verdict != "trustworthy"]
    return cal, [*explained, *reasons, *(f.words for f in checks if f.verdict == "trustworthy")]


def cases(quick: bool) -> list[tuple[str, str, Bend]]:
    found = []
    for bend in BENDS:
        for where in bend.where:  # every second case is run: each bend in six of its twelve combinations
            names = ("paper", "two angles", "small") if where in ("hexapod", "two balls") or not quick else ("small",)
            found += [(plan, where, bend) for plan in names]
    return found[:: 4 if quick else 2]


def table(outcomes: list[Outcome], title: str) -> None:
    print(f"\n{title}")
    print(
        f"{'bend':20s} {'size':16s} {'runs':>4s} {'trust':>5s} {'> 3 s':>5s} {'worst':>7s} {'true':>8s} {'named':>5s}"
    )
    groups: dict[tuple[str, str], list[Outcome]] = defaultdict(list)
    for o in outcomes:
        groups[o.bend, o.size].append(o)
    for (bend, size), group in groups.items():
        trusted = [o for o in group if o.verdict == "trustworthy"]
        bad = [o for o in trusted if o.ratio > 3 and o.true > FLOOR]
        worst = max((o.ratio for o in trusted if o.true > FLOOR), default=np.nan)
        named = [o.named for o in group if o.named is not None]
        share = f"{sum(named)}/{len(named)}" if named else "-"
        true = np.nanmedian([o.true for o in group])
        print(
            f"{bend:20s} {size:16s} {len(group):4d} {len(trusted):5d} {len(bad):5d} {worst:7.2f} {true:8.4f} {share:5s}"
        )


def summary(bent: list[Outcome], clean: list[Outcome], drawn: list[Outcome]) -> dict[str, float]:
    trusted = [o for o in bent if o.verdict == "trustworthy"]
    above = [o for o in trusted if o.true > FLOOR]
    bad = [o for o in above if o.ratio > 3]
    # an effect that the images do not show at all cannot be named
    named = [o.named for o in bent if o.named is not None and o.first]
    inside = [abs(v) < 1.96 for o in drawn for v in o.shift.values()]
    return {
        "bent runs": len(bent),
        "trustworthy": len(trusted),
        "trustworthy, error above 3 sigma": len(bad),
        "share": len(bad) / max(len(trusted), 1),
        "worst ratio": max((o.ratio for o in above), default=0.0),
        "clean runs": len(clean),
        "clean trustworthy": sum(o.verdict == "trustworthy" for o in clean) / max(len(clean), 1),
        "clean median ratio": float(np.median([o.ratio for o in clean])) if clean else np.nan,
        "drawn trustworthy": sum(o.verdict == "trustworthy" for o in drawn) / max(len(drawn), 1),
        "drawn 95 % intervals": float(np.mean(inside)) if inside else np.nan,
        "drawn median ratio": float(np.median([o.ratio for o in drawn])) if drawn else np.nan,
        "drawn above 3 sigma": sum(o.ratio > 3 for o in drawn if o.verdict == "trustworthy") / max(len(drawn), 1),
        "culprit first": float(np.mean(named)) if named else np.nan,
        "CPU ms, median": float(np.median([o.ms for o in clean + bent])),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="every fourth case, three clean runs a group")
    parser.add_argument("--only", default="", help="bends whose name holds these words")
    parser.add_argument("--list", action="store_true", help="one line a run")
    parser.add_argument("--json", default="", help="write the figures there")
    parser.add_argument("--clean", type=int, default=0, help="clean runs a plan and arrangement")
    given = parser.parse_args()
    exact = dict.fromkeys((*SIZES, "axis_y", "axis_tilt_x", "axis_tilt_y"), 0.0)
    one("small", "hexapod", None, 0, sigma={})  # compiles
    chosen = [c for c in cases(given.quick) if given.only in c[2].name]
    bent = [one(plan, where, bend, k, sigma={}) for k, (plan, where, bend) in enumerate(chosen)]
    repeats = given.clean or (3 if given.quick else 9)
    groups = [(p, w) for p in ("paper", "two angles", "small") for w in ARRANGEMENTS]
    clean, drawn = [], []
    if not given.only:
        try:
            clean = [one(p, w, None, 1000 + k, sigma=exact) for p, w in groups for k in range(repeats)]
        except tp.errors.TomoposeError:  # before 0 meant exact
            clean = [one(p, w, None, 1000 + k, sigma={}) for p, w in groups for k in range(repeats)]
        drawn = [one(p, w, None, 2000 + k, sigma={}, draw=True) for p, w in groups for k in range(repeats)]
    if given.list:
        for o in bent + clean + drawn:
            print(
                f"{o.plan:11s} {o.where:8s} {o.bend:24s} {o.size:16s} {o.verdict:12s} true {o.true:8.4f} stated "
                f"{o.stated:8.4f} shared {o.shared:8.4f} {o.named!s:6s} {o.ms:6.0f} ms  {o.first[:110]}"
            )
    table(bent, "Bent reality")
    figures = summary(bent, clean, drawn)
    print()
    for name, value in figures.items():
        print(f"{name:36s} {value:.4g}")
    if given.json:
        with open(given.json, "w") as file:
            json.dump(figures, file, indent=1)


if __name__ == "__main__":
    main()
