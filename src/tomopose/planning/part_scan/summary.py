"""A planned scan as the content of scan.json."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np

from tomopose.manipulator.serial import in_unit
from tomopose.planning.part.settings import LIFT_MM, PLANES, WEIGHTS, PartSettings
from tomopose.planning.part_scan.plan import Judged, PartScanPlan
from tomopose.planning.part_scan.robot_at_work import RobotAtWork

Content: TypeAlias = dict[str, object]


def _finite(value: float) -> float | None:
    """None where nothing is known of it: JSON has no infinity."""
    return float(value) if math.isfinite(value) else None


def _judged(j: Judged) -> Content:
    w = j.worth
    return {
        "J": w.J,
        "C": w.C,
        "T": w.T,
        "M": w.M,
        "worst_transmission": w.worst_transmission,
        "worst_point": list(w.worst_point),
        "largest_gap_deg": math.degrees(w.gap),
        "travel": j.travel,
        "duration_s": j.duration,
        "views_out_of_view": j.out_of_view,
        "features": [
            {
                "name": f.name,
                "seen_share": f.seen_share,
                "u_mm": _finite(f.u),
                "u_radius_mm": _finite(f.u_size),
                "median_views": f.views,
                "seen_share_without_best_view": f.without_best,
            }
            for f in j.features
        ],
        "lengths": [{"name": name, "u_mm": _finite(u), **_drawn(j, name)} for name, u in j.lengths.items()],
    }


def _drawn(j: Judged, name: str) -> Content:
    """Of a length: how many drawn scans show it, and the relative uncertainty that so many leave its u."""
    if name not in j.measured:
        return {}
    n = j.measured[name]
    return {"draws_measured": n, "relative_u_of_u": 1 / math.sqrt(2 * (n - 1)) if n > 1 else None}


def _constants(s: PartSettings) -> Content:
    return {
        "mu_per_mm": s.mu,
        "least_transmission": s.least_transmission,
        "least_view_transmission": s.least_view_transmission,
        "tangent_deg": math.degrees(s.tangent),
        "tuy_deg": math.degrees(s.tuy_width),
        "weights_C_T_M": list(WEIGHTS),
        "planes": PLANES,
        "lift_mm": LIFT_MM,
        "margin_px": s.margin,
        "quanta": s.quanta,
        "readout_quanta": s.readout,
        "blur_px": s.blur,
        "sweeps": s.sweeps,
        "room_mm": s.room,
        "uncertainty": s.uncertainty,
        "draws": s.draws if s.uncertainty == "drawn" else None,
        "beam_energies": len(s.beam) or 1,
        "seed": s.seed,
    }


def _joints(plan: PartScanPlan) -> list[Content] | None:
    """How far each joint of a robot goes and may go; None for other machines."""
    if not isinstance(plan.machine.manipulator, RobotAtWork) or plan.poses.q is None:
        return None
    out: list[Content] = []
    for k, (unit, q) in enumerate(zip(plan.machine.joint_units, plan.poses.q.T, strict=True)):
        low, high, *limits = (in_unit(x, unit) for x in (q.min(), q.max(), *plan.machine.manipulator.limits[:, k]))
        out.append({"joint": k + 1, "unit": unit, "lowest": low, "highest": high, "limits": limits})
    return out


def plan_document(plan: PartScanPlan) -> Content:
    """What scan.json holds: figures of the plan and of the usual paths, certificate, what stays unseen, constants."""
    limits = plan.machine.limits
    bounds = np.stack([limits.low, limits.high])
    bounds[:, 3:] = np.degrees(bounds[:, 3:])
    names = ("x_mm", "y_mm", "z_mm", "rx_deg", "ry_deg", "rz_deg", "alpha_deg")
    return {
        "part": plan.goal.part.name,
        "views": len(plan),
        "candidates": plan.candidates,
        **_judged(plan.chosen),
        "bound": plan.bound,
        "certificate": {
            "J": plan.planned_J,
            "bound": plan.bound,
            "ratio": plan.planned_J / plan.bound,
            "of": "the candidates and the chosen views, on the points that were planned with; not of the continuum",
        },
        "paths": {name: _judged(j) for name, j in plan.paths.items()},
        "unseen": [{"name": name, "why": why} for name, why in plan.unseen.items()],
        "dropped": {"views": plan.dropped[0], "J": plan.dropped[1]},
        "continuous": plan.way is not None,
        "way": None if plan.way is None else {"places": len(plan.way), "places_not_allowed": plan.way_blocked},
        "transmission_by_view": plan.chosen.tau.tolist(),
        "joints": _joints(plan),
        "home": None if plan.machine.home is None else plan.machine.home.matrix.tolist(),
        "limits": {name: bounds[:, k].tolist() for k, name in enumerate(names)},
        "assumed_limits": list(plan.limits.assumed),
        "constants": _constants(plan.settings),
        "definitions": "docs/concepts/planning.md",
    }


def plan_lines(plan: PartScanPlan) -> list[str]:
    """The plan for people: what was reached, what bounds it, what the usual paths reach, what stays unseen."""
    lines = [
        f"  {plan.candidates} candidates; J {plan.planned_J:.4f} of at most {plan.bound:.4f} "
        f"({100 * plan.planned_J / plan.bound:.1f} % of the bound)",
        f"  {'':<9}{'J':>7}{'C':>7}{'T':>7}{'M':>7}{'travel':>8}  on other points than planned with",
    ]
    for name, j in (("plan", plan.chosen), *plan.paths.items()):
        w = j.worth
        out = f"; {j.out_of_view} views out of view" if j.out_of_view else ""
        lines.append(f"  {name:<9}{w.J:7.3f}{w.C:7.3f}{w.T:7.3f}{w.M:7.3f}{j.travel:8.0f}{out}")
    lines += _uncertainty_lines(plan)
    lines += [f"  {name}: {why}" for name, why in plan.unseen.items()]
    if plan.way is not None and plan.way_blocked:
        lines.append(
            f"  {plan.way_blocked} of {len(plan.way)} places between the views are not allowed (view, stroke or "
            "keep-out); stop there and go around, or ask for more views"
        )
    if plan.dropped[0]:
        lines.append(
            f"  {plan.dropped[0]} views left out to keep the time limit; they would have added {plan.dropped[1]:.4f}"
        )
    return lines


def _uncertainty_lines(plan: PartScanPlan) -> list[str]:
    """Which lengths have no predicted uncertainty, and which are missing from some of the drawn scans."""
    s, out = plan.settings, []
    for name, u in plan.chosen.lengths.items():
        n = plan.chosen.measured.get(name, s.draws)
        if n < s.draws:
            given = "no uncertainty is predicted" if not math.isfinite(u) else "its uncertainty is that of these"
            out.append(f"  {name}: measured in {n} of {s.draws} drawn scans; {given}")
        elif not math.isfinite(u):
            out.append(f"  {name}: no edge is to be expected at one of its features; no uncertainty is predicted")
    return out
