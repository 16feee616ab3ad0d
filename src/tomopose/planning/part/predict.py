"""The standard uncertainty of features and lengths that the noise of a set of views lets expect.

Noise moves each edge (`expected_edges`), the feature's least-squares fit takes the edges to its parameters, and the
measurand takes these to a length:

    d length = sum_f (d length / d vector_f) D_f e_f,      e_i = sum_k L_ik g_ik

so that a length is one sum over grey levels of the volume, whose variance `SartResponse.covariance` gives by filters,
or `SartSteps.covariance` through SART's own steps, with all correlation between voxels, points and the two features.
A third prediction takes nothing as linear: the scatter of drawn scans (`drawn`).
What it holds: the quanta and the readout, the views' geometry and transmission, blur, SART, the fit; and, with a
calibration, its shared uncertainty.  What it does not hold: every systematic deviation (artefacts of few views and of
the cone beam, beam hardening, scatter, sampling by voxels).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array, hstack, vstack

from tomopose.errors import InputError
from tomopose.geometry.scanner import Scanner
from tomopose.measurement.alignment import Alignment
from tomopose.measurement.features.feature import Feature
from tomopose.measurement.features.shapes import frame_along
from tomopose.measurement.measure import evaluate
from tomopose.measurement.plan import MeasurandPlan, MeasurementPlan
from tomopose.planning.part.drawn import drawn_scans, scatter, scatter_of_place
from tomopose.planning.part.expected_edges import FEWEST_EDGES, ExpectedEdges, expected_edges
from tomopose.planning.part.sart_response import SartResponse, sart_response
from tomopose.planning.part.sart_steps import SartSteps, sart_steps
from tomopose.planning.part.targets import Target, probed_targets
from tomopose.planning.part.worth import Goal, Views
from tomopose.trajectory.completeness import source_path
from tomopose.units import Array

PROBED = 500
"""Points of a feature at most: noise is alike over a voxel, and more points say nothing new."""
SINGLE_POINTS = 24
"""Of a surface without a shape, whose uncertainty is that of single points."""
STEP = 1e-4
"""mm and rad, of the differences that lengths are derived by."""
PREDICTED = ("distance", "diameter")
NOWHERE = Alignment(R=np.eye(3), t=np.zeros(3), rule="given")


@dataclass(frozen=True, kw_only=True)
class Predicted:
    """u: mm, of the feature's position along its normal (the largest over the directions that it has);
    u_size: mm, of its radius, nan where it has none;  views: how many see it at a point, the median;
    without_best: seen share if the view that shows most of it were lost.  u is inf where no edge is to be expected."""

    name: str
    seen_share: float
    u: float
    u_size: float
    views: float
    without_best: float


class Prediction(NamedTuple):
    """features: each target;  lengths: standard uncertainty, mm, of each distance and diameter of the plan;
    measured: how many of the drawn scans show each of these, where scans were drawn."""

    features: list[Predicted]
    lengths: dict[str, float]
    measured: dict[str, int]


Progress = Callable[[str], None]


def silent(_: str) -> None:
    """Progress that nobody looks at."""


def predicted(
    goal: Goal,
    scanner: Scanner,
    P: Array,
    views: Views,
    *,
    plan: MeasurementPlan | None = None,
    shared: Array | None = None,
    response: SartResponse | SartSteps | None = None,
    progress: Progress = silent,
) -> Prediction:
    """What the noise of views with matrices P (n, 3, 4) lets expect, in the way that the settings say.

    shared: (targets,) mm, what the calibration adds to the place of each, in quadrature.  response: what SART makes of
    the views, in place of what it makes of the part alone;  progress: is given a line now and then.
    """
    measured: dict[str, int] = {}
    if goal.settings.uncertainty == "drawn" and response is None:
        u, sizes, lengths, measured = _from_draws(goal, scanner, P, plan, progress)
    else:
        u, sizes, lengths = _from_noise(goal, scanner, P, plan, response)
    own = np.zeros(len(goal.targets)) if shared is None else shared
    out = []
    for k, target in enumerate(goal.targets):
        seen = views.A[:, goal.rows[target.name]] > 0
        times = seen.sum(axis=0)
        lonely = seen & (times == 1)
        out.append(
            Predicted(
                name=target.name,
                seen_share=float((times > 0).mean()),
                u=float(np.hypot(u[k], own[k])),
                u_size=float(sizes[k]),
                views=float(np.median(times)),
                without_best=float((times > 0).mean() - lonely.mean(axis=1).max(initial=0.0)),
            )
        )
    by = dict(zip((t.name for t in goal.targets), own, strict=True))
    for m in () if plan is None else plan.measurands:
        if m.kind == "distance" and m.name in lengths:
            lengths[m.name] = float(np.linalg.norm([lengths[m.name], *(by[f] for f in m.of)]))
    return Prediction(out, lengths, measured)


def _in_front(goal: Goal, P: Array) -> bool:
    """Whether the whole part lies between source and panel in all views, so that there are images of it."""
    depth = goal.part.hull @ P[:, 2, :3].T + P[:, 2, 3]
    return bool((depth > 0).all())


def _from_draws(
    goal: Goal, scanner: Scanner, P: Array, plan: MeasurementPlan | None, progress: Progress
) -> tuple[Array, Array, dict[str, float], dict[str, int]]:
    """As `_from_noise`, from drawn scans, and how many of them show each length."""
    targets, asked = goal.targets, None
    if plan is not None and plan.features:
        wanted = tuple(m for m in plan.measurands if m.kind in PREDICTED and set(m.of) <= plan.features.keys())
        asked = plan.model_copy(update={"measurands": wanted, "spheres": None})
    names = () if asked is None else tuple(m.name for m in asked.measurands)
    if not _in_front(goal, P):
        nothing = np.full(len(targets), np.inf)
        return nothing, nothing, dict.fromkeys(names, np.inf), dict.fromkeys(names, 0)
    scans = drawn_scans(goal, scanner, P, plan=asked, progress=progress)
    u = np.array([scatter_of_place(t, scans.points[t.name]) for t in targets])
    sizes = np.array([scatter(scans.radii[t.name]) if t.name in scans.radii else np.nan for t in targets])
    lengths = {name: scatter(x) for name, x in scans.lengths.items()}
    return u, sizes, lengths, {name: int(np.isfinite(x).sum()) for name, x in scans.lengths.items()}


def _from_noise(
    goal: Goal,
    scanner: Scanner,
    P: Array,
    plan: MeasurementPlan | None,
    response: SartResponse | SartSteps | None,
) -> tuple[Array, Array, dict[str, float]]:
    """(u of the place, u of the radius) (targets,) and of the lengths, mm, from the noise alone."""
    if plan is not None and plan.features:
        goal = replace(goal, targets=probed_targets(plan, PROBED))
    targets = goal.targets
    wanted = () if plan is None else _lengths(targets, plan)
    if not _in_front(goal, P):
        nothing = np.full(len(targets), np.inf)
        return nothing, nothing, {m.name: np.inf for m in wanted}
    if response is None:
        exact = goal.settings.uncertainty == "exact"
        response = (sart_steps if exact else sart_response)(goal.part, scanner, P, goal.settings)
    edges = {t.name: expected_edges(response, t.x, t.n) for t in targets}
    rows: list[csr_array] = []
    for target in targets:
        rows += [_spread(edges, {target.name: w}) for w in (*_place_rows(target), *_size_rows(target))]
    slopes = {} if plan is None else _slopes(targets, plan, wanted)
    rows += [_spread(edges, slopes[m.name]) for m in wanted]
    x = np.concatenate([e.x.reshape(-1, 3) for e in edges.values()])
    C = response.covariance(x, csr_array(vstack(rows)))
    clear = {name: bool(e.found.mean() >= FEWEST_EDGES) for name, e in edges.items()}
    u, sizes, k = np.empty(len(targets)), np.full(len(targets), np.nan), 0
    for i, target in enumerate(targets):
        n_place, n_size = len(_place_rows(target)), len(_size_rows(target))
        own = C[k : k + n_place, k : k + n_place]
        single = target.shape is None and target.kind not in ("plane", "line")
        square = float(np.trace(own) / n_place if single else np.linalg.eigvalsh(own)[-1])
        u[i] = np.sqrt(max(square, 0.0)) if clear[target.name] else np.inf
        if n_size:
            sizes[i] = np.sqrt(C[k + n_place, k + n_place]) if clear[target.name] else np.inf
        k += n_place + n_size
    of: Array = np.sqrt(np.diag(C)[k:])
    known = [all(clear[f] for f in m.of) for m in wanted]
    return u, sizes, {m.name: float(x) if c else np.inf for m, x, c in zip(wanted, of, known, strict=True)}


def _spread(edges: Mapping[str, ExpectedEdges], weights: Mapping[str, Array]) -> csr_array:
    """(1, samples) weights of grey levels, from weights (m,) of the edges of some targets."""
    out = []
    for name, e in edges.items():
        if name not in weights:
            out.append(csr_array((1, e.L.size)))
            continue
        w = np.where(e.found, weights[name], 0.0)
        w *= np.abs(weights[name]).sum() / max(float(np.abs(w).sum()), 1e-300)
        out.append(csr_array((w[:, None] * np.where(e.found[:, None], e.L, 0.0)).reshape(1, -1)))
    return csr_array(hstack(out))


def _parameters(target: Target) -> Array:
    """(p, m): by how much the parameters of `derivatives` move with each point's edge along its normal."""
    inverse: Array = np.asarray(np.linalg.pinv(target.derivatives()), dtype=np.float64)
    if target.shape is None:
        return inverse
    return -inverse * target.outward


def _place_rows(target: Target) -> Array:
    """(k, m): along each direction that the feature's place has; of single points without a shape."""
    if target.shape is None and target.kind not in ("plane", "line"):
        rows = np.linspace(0, len(target.x) - 1, min(SINGLE_POINTS, len(target.x))).astype(int)
        return np.asarray(np.eye(len(target.x))[rows])
    return _parameters(target)[: 1 if target.shape is None else 3 if target.shape.kind == "sphere" else 2]


def _size_rows(target: Target) -> Array:
    """(1 or 0, m): the radius."""
    if target.shape is None:
        return np.zeros((0, len(target.x)))
    k = {"sphere": 3, "circle": 2, "cylinder": 4, "cone": 4}[target.shape.kind]
    return _parameters(target)[k : k + 1]


def _vector_rows(target: Target) -> tuple[Array, Array]:
    """(vector (8,), its derivatives (8, m) by each point's edge), as `measurement.features.feature` orders them."""
    vector, D, p = np.full(8, np.nan), np.zeros((8, len(target.x))), _parameters(target)
    if target.shape is None:
        frame, middle = frame_along(target.n[0]), target.x.mean(axis=0)
        vector[:3], vector[3:6] = middle, frame[2]
        D[:3] = np.outer(frame[2], p[0])
        if target.kind == "plane":
            D[3:6] = -frame[:2].T @ p[1:3]
        else:
            vector[3:6], along = target.along, (target.x - middle) @ target.along
            D[3:6] = np.outer(frame[2], along / (along @ along))
        return vector, D
    s = target.shape
    vector[:3], vector[6] = s.point, s.radius
    if s.kind == "sphere":
        D[:3], D[6] = p[:3], p[3]
        return vector, D
    vector[3:6], D[:3] = s.frame[2], s.frame[:2].T @ p[:2]
    D[6] = p[2 if s.kind == "circle" else 4]
    if s.kind != "circle":
        D[3:6] = s.frame[:2].T @ p[2:4]
    if s.kind == "cone":
        vector[7], D[7] = s.psi, p[5]
    return vector, D


def _values(targets: tuple[Target, ...], plan: MeasurementPlan, moved: Mapping[str, Array]) -> list[float]:
    """Of the plan's measurands, with the vectors of some features moved."""
    at = {t.name: _feature(t, moved.get(t.name, _vector_rows(t)[0])) for t in targets}
    return [r.value for r in evaluate(plan, at, NOWHERE)]


def _lengths(targets: tuple[Target, ...], plan: MeasurementPlan) -> tuple[MeasurandPlan, ...]:
    """The measurands that are predicted: distances and diameters of least-squares features that have a rule."""
    out = []
    for m in plan.measurands:
        known = all(f in plan.features and plan.features[f].reference == "least-squares" for f in m.of)
        if m.kind not in PREDICTED or m.reference is not None or not known:
            continue
        try:
            _values(targets, plan.model_copy(update={"measurands": (m,), "spheres": None}), {})
        except InputError:  # the measurement will say so
            continue
        out.append(m)
    return tuple(out)


def _slopes(
    targets: tuple[Target, ...], plan: MeasurementPlan, wanted: tuple[MeasurandPlan, ...]
) -> dict[str, dict[str, Array]]:
    """Length -> target -> (m,) derivative of the length by each point's edge, by central differences."""
    ways = {t.name: _vector_rows(t) for t in targets}
    out: dict[str, dict[str, Array]] = {m.name: {} for m in wanted}
    for name, (vector, D) in ways.items():
        of_it = tuple(m for m in wanted if name in m.of)
        bare = plan.model_copy(update={"measurands": of_it, "spheres": None})
        for k in np.flatnonzero(D.any(axis=1)) if of_it else ():
            above, below = (_values(targets, bare, {name: vector + h * np.eye(8)[k]}) for h in (STEP, -STEP))
            for m, high, low in zip(of_it, above, below, strict=True):
                slope = (high - low) / (2 * STEP) * D[k]
                out[m.name][name] = out[m.name].get(name, np.zeros(D.shape[1])) + slope
    return out


def _feature(target: Target, vector: Array) -> Feature:
    """The nominal feature as if it had been measured without scatter."""
    n = len(target.x)
    return Feature(
        kind=target.kind,
        vector=vector,
        covariance=np.zeros((8, 8)),
        points=target.x,
        used=np.ones(n, dtype=bool),
        residuals=np.zeros(n),
        n_effective=float(n),
        dof=float(n),
    )


def shared_part(goal: Goal, scanner: Scanner, P: Array, sigma_px: Array) -> Array:
    """(targets,) mm: the calibration's shared standard uncertainty in px at points, (targets,), at the object."""
    depth = np.array([np.mean(P[:, 2, :3] @ t.x.mean(axis=0) + P[:, 2, 3]) for t in goal.targets])
    return np.asarray(sigma_px * scanner.p_u * depth / scanner.d_SD)


def why_unseen(goal: Goal, views: Views, target: Target) -> str:
    """In words, why no candidate sees some of a target's points, and which further tilt would."""
    rows, s = goal.rows[target.name], goal.settings
    hidden = np.flatnonzero(views.A[:, rows].max(axis=0) == 0)
    angle = np.degrees(np.arcsin(np.clip(views.incidence[:, rows][:, hidden], 0, 1)))
    least = angle.min(axis=0)
    grazed = least <= np.degrees(s.tangent)
    if grazed.mean() > 0.5:
        tau = np.where(angle <= np.degrees(s.tangent), views.tau[:, rows][:, hidden], 0.0).max(axis=0)
        L = -np.log(np.maximum(np.median(tau[grazed]), 1e-300)) / s.mu
        return (
            f"the rays along it pass through {L:.3g} mm of material (transmission {np.median(tau[grazed]):.2g}, "
            f"{s.least_transmission:g} is needed): a higher voltage, or another placing of the part"
        )
    k = int(hidden[int(least.argmax())])
    d = target.x[k] - source_path(views.P)[int(views.incidence[:, rows][:, k].argmin())]
    d /= np.linalg.norm(d)
    turn = np.cross(d, target.n[k])
    turn /= max(float(np.linalg.norm(turn)), 1e-12)
    return (
        f"no ray comes nearer to its tangent plane than {least.max():.3g} deg: tilt the fixture by "
        f"{max(least.max() - np.degrees(s.tangent), 0.0):.3g} deg about ({turn[0]:.2f}, {turn[1]:.2f}, {turn[2]:.2f}), "
        "or allow more tilt"
    )
