"""Five parts with their features: plate with bores, L-bracket, tall thin box, blade, the paper's specimen; mm in W."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from manifold3d import CrossSection, Manifold

import tomopose as tp
from tomopose.measurement.mesh.mesh import Mesh
from tomopose.measurement.plan import plan_from
from tomopose.planning.part.part import Part
from tomopose.simulation.objects.specimen import CUBOID_HEIGHTS, FLANGE_RADIUS, FLAT, specimen_mesh

SEGMENTS, N_POINTS = 96, 300


@dataclass(frozen=True, kw_only=True)
class Case:
    """A part with its plan, attenuation (1/mm), scanner's magnification and largest tilt (deg).

    plan: what views are chosen and judged by; None for the whole surface;  lengths: what is measured in virtual
    scans, whose panel is read out in blocks of `binning`.
    """

    part: Part
    plan: tp.MeasurementPlan | None
    lengths: tp.MeasurementPlan
    binning: int = 2
    mu: float
    d_SR: float
    tilt: float


def _part(name: str, solid: Manifold) -> Part:
    mesh = solid.to_mesh64()
    return Part(mesh=Mesh(points=np.array(mesh.vert_properties[:, :3]), faces=np.array(mesh.tri_verts)), name=name)


def _box(size: tuple[float, float, float], centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Manifold:
    return Manifold.cube(size, True).translate(centre)


def _bore(radius: float, length: float, centre: tuple[float, float, float]) -> Manifold:
    return Manifold.cylinder(length, radius, radius, SEGMENTS, True).translate(centre)


def _plane(point: list[float], n: list[float], u: list[float], v: list[float]) -> dict[str, object]:
    return {"kind": "plane", "point": point, "direction": n, "u": u, "v": v, "n_points": N_POINTS}


def _cylinder(point: list[float], radius: float, length: float, *, inward: bool = True) -> dict[str, object]:
    axis = [0, 0, 1]
    shape = {"kind": "cylinder", "point": point, "direction": axis, "radius_mm": radius, "length_mm": length}
    return {**shape, "inward": inward, "n_points": N_POINTS}


def _plan(features: dict[str, object], distances: list[tuple[str, str]]) -> tp.MeasurementPlan:
    diameters = [
        {"name": f"D {name}", "kind": "diameter", "of": [name]}
        for name, f in features.items()
        if isinstance(f, dict) and f["kind"] == "cylinder"
    ]
    lengths = [{"name": f"{a} to {b}", "kind": "distance", "of": [a, b]} for a, b in distances]
    document = {"schema": "tomopose/measurement-plan/1", "unit": "mm", "features": features}
    return plan_from({**document, "measurands": diameters + lengths})


def plate() -> Case:
    """54 x 40 x 4 mm with five bores, lying."""
    places = [(-18, -10), (18, -10), (-18, 10), (18, 10), (0, 0)]
    solid = _box((54, 40, 4))
    features: dict[str, object] = {
        "top": _plane([9, 0, 2], [0, 0, 1], [4, 0, 0], [0, 15, 0]),
        "bottom": _plane([9, 0, -2], [0, 0, -1], [4, 0, 0], [0, 15, 0]),
        "right": _plane([27, 0, 0], [1, 0, 0], [0, 18, 0], [0, 0, 1.5]),
        "left": _plane([-27, 0, 0], [-1, 0, 0], [0, 18, 0], [0, 0, 1.5]),
    }
    for k, (x, y) in enumerate(places):
        radius = 3 + 0.5 * k
        solid -= _bore(radius, 10, (x, y, 0))
        features[f"bore {k}"] = _cylinder([x, y, 0], radius, 4)
    plan = _plan(features, [("top", "bottom"), ("left", "right")])
    return Case(
        part=_part("plate", solid),
        plan=plan,
        lengths=plan,
        mu=0.06,
        d_SR=400.0,
        tilt=20.0,
    )


def bracket() -> Case:
    """An L of 30 mm legs, 6 mm thick, with a bore in each."""
    solid = _box((30, 24, 6), (0, 0, -12)) + _box((6, 24, 30), (-12, 0, 0))
    solid -= _bore(4, 20, (6, 0, -12))
    solid -= _bore(3, 20, (0, 0, 0)).rotate((0, 90, 0)).translate((-12, 0, 6))
    side = {"kind": "cylinder", "point": [-12, 0, 6], "direction": [1, 0, 0], "radius_mm": 3.0, "length_mm": 6.0}
    features: dict[str, object] = {
        "foot": _plane([6, 0, -9], [0, 0, 1], [1.5, 0, 0], [0, 11, 0]),
        "sole": _plane([0, 9, -15], [0, 0, -1], [13, 0, 0], [0, 2, 0]),
        "back": _plane([-15, 0, -6], [-1, 0, 0], [0, 11, 0], [0, 0, 4]),
        "bore": _cylinder([6, 0, -12], 4, 6),
        "side bore": {**side, "inward": True},
    }
    plan = _plan(features, [("foot", "sole")])
    return Case(part=_part("bracket", solid), plan=plan, lengths=plan, mu=0.06, d_SR=400.0, tilt=15.0)


def tall_box() -> Case:
    """12 x 12 x 60 mm with walls of 1.5 mm, open above."""
    solid = _box((12, 12, 60)) - _box((9, 9, 60), (0, 0, 1.5))
    features: dict[str, object] = {
        "floor": _plane([0, 0, -28.5], [0, 0, 1], [4, 0, 0], [0, 4, 0]),
        "sole": _plane([0, 0, -30], [0, 0, -1], [5, 0, 0], [0, 5, 0]),
        "left": _plane([-6, 0, 0], [-1, 0, 0], [0, 5, 0], [0, 0, 25]),
        "right": _plane([6, 0, 0], [1, 0, 0], [0, 5, 0], [0, 0, 25]),
        "inner": _plane([4.5, 0, 0], [-1, 0, 0], [0, 4, 0], [0, 0, 25]),
    }
    distances = [("floor", "sole"), ("left", "right"), ("inner", "right")]
    plan = _plan(features, distances)
    return Case(part=_part("tall box", solid), plan=plan, lengths=plan, binning=1, mu=0.08, d_SR=420.0, tilt=15.0)


def blade() -> Case:
    """A twisted profile of 30 mm on a block: no features, the whole surface counts."""
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    profile = np.column_stack([11 * np.cos(angle), 1.6 * np.sin(angle) + 1.5 * np.cos(angle) ** 2])
    wing = CrossSection([profile.tolist()]).extrude(30, 24, 35.0, (0.7, 0.9))
    solid = wing.translate((0, 0, -10)) + _box((26, 10, 6), (0, 0.5, -12))
    block: dict[str, object] = {
        "left": _plane([-13, 0.5, -12], [-1, 0, 0], [0, 4.5, 0], [0, 0, 2.5]),
        "right": _plane([13, 0.5, -12], [1, 0, 0], [0, 4.5, 0], [0, 0, 2.5]),
        "front": _plane([0, -4.5, -12], [0, -1, 0], [12, 0, 0], [0, 0, 2.5]),
        "back": _plane([0, 5.5, -12], [0, 1, 0], [12, 0, 0], [0, 0, 2.5]),
    }
    lengths = _plan(block, [("left", "right"), ("front", "back")])
    return Case(part=_part("blade", solid), plan=None, lengths=lengths, mu=0.1, d_SR=380.0, tilt=15.0)


def specimen() -> Case:
    """The paper's specimen (sec. 6.2), coarsely meshed, without features: the whole surface counts."""
    mesh = specimen_mesh(edge=4.0, segments=48)
    part = Part(mesh=Mesh(points=mesh.vertices, faces=np.asarray(mesh.faces)), name="specimen")
    features: dict[str, object] = {
        "lower flange": _cylinder([0, 0, -24], FLANGE_RADIUS, 10, inward=False),
        "upper flange": _cylinder([0, 0, 24], FLANGE_RADIUS, 10, inward=False),
    }
    for k in (1, 3, 5):
        c, s, side = np.cos(k * np.pi / 3), np.sin(k * np.pi / 3), 1 if k % 2 else -1
        out, along, up = np.array([c, s, 0.0]), [-3 * s, 3 * c, 0.0], [0.0, 0.0, 1.0]
        outer = (FLAT + CUBOID_HEIGHTS[k]) * out + np.array([0.0, 0.0, 9.0 * side])
        flat = FLAT * out - np.array([0.0, 0.0, 7.0 * side])
        features[f"flat {k}"] = _plane(flat.tolist(), out.tolist(), along, [8 * w for w in up])
        features[f"cuboid {k}"] = _plane(outer.tolist(), out.tolist(), [0.75 * w for w in along], [3.5 * w for w in up])
    lengths = _plan(features, [(f"flat {k}", f"cuboid {k}") for k in (1, 3, 5)])
    return Case(part=part, plan=None, lengths=lengths, mu=0.06, d_SR=420.0, tilt=8.0)


CASES = {"plate": plate, "bracket": bracket, "tall box": tall_box, "blade": blade, "specimen": specimen}
