"""CTSimU scenarios 1.0 to 1.2, read: where source, panel and stage are in every frame, as a reconstruction knows it.

Per frame and part: the standard pose, the stage's turn about w between start and stop angle, the deviations in their
order (about world axes x, y, z or the part's own axes u, v, w as they then are), and at last the drift of the centre.
Only what is `known_to_reconstruction` counts.  A list of drift values, in the scenario or in a file that it names, is
stretched over the scan and interpolated linearly.  A parameter that is null is not relevant: the toolbox counts it as
0, and so does this reader, where the geometry can do without it.  W is the stage turned by 180 degrees about its w
axis. Source: CTSimU scenario file format 1.2.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np

from tomopose.errors import FileError, InputError, SchemaVersionError, UnitError
from tomopose.exports.panel import Given, matrices_of_panels, numbers
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.geometry.rotations import R_z, exp_rotation
from tomopose.units import Array, float_array

MOST_VIEWS = 100_000
"""A scan of a month, at one view in half a minute; each view is an entry of several arrays."""
NEWEST = (1, 2)
UNITS: Mapping[str, Mapping[str, float]] = {
    "mm": {"nm": 1e-6, "um": 1e-3, "mm": 1.0, "cm": 10.0, "dm": 100.0, "m": 1000.0},
    "rad": {"rad": 1.0, "deg": np.pi / 180},
    "": {"": 1.0},
    "px": {"": 1.0, "px": 1.0},
}
REMARKS = ("comment", "comments", "description", "name", "type", "beam_divergence", "uncertainty", "uncertainty_unit")


def from_ctsimu(content: Mapping[str, Any], given: Given, *, where: str = "the CTSimU scenario") -> ProjectionMatrices:
    """Matrices of a scenario's JSON content.  v counts upwards in them, whatever the order of the image files.

    Raises InputError, with the place in the file, where it says something that is not read: parts attached to the
    stage, drifts of direction vectors, pixel binning, deviations of formats before 1.0.  Drift files are looked for
    from `given.folder`; FileError names one that is not there.
    """
    _check_version(content, where)
    acquisition = _section(content, "acquisition", where)
    files = _Files(given.folder)
    n = acquisition.get("number_of_projections")
    n = n.get("value") if isinstance(n, Mapping) else n
    if isinstance(n, bool) or not isinstance(n, int) or n < 1:
        raise InputError(f"{where}: acquisition.number_of_projections is {n!r}; a positive whole number is needed")
    if n > MOST_VIEWS:
        raise InputError(f"{where}: acquisition.number_of_projections is {n}; at most {MOST_VIEWS} are read")
    binning = {} if acquisition.get("pixel_binning") is None else _section(acquisition, "pixel_binning", where)
    for axis, factor in binning.items():
        if (factor.get("value") if isinstance(factor, Mapping) else factor) not in (None, 1):
            raise InputError(f"{where}: acquisition.pixel_binning.{axis} is {factor!r}; only unbinned scans are read")
    geometry, detector = _section(content, "geometry", where), _section(content, "detector", where)
    if _section(geometry, "source", f"{where}: geometry").get("type") == "parallel":
        raise InputError(f"{where}: geometry.source.type is 'parallel'; only cone beams are read")
    parts = {
        name: _part(files.filled(_section(geometry, name, f"{where}: geometry")), n, f"{where}: geometry.{name}", turn)
        for name, turn in (("source", None), ("detector", None), ("stage", stage_angles(acquisition, n, where)))
    }
    pitch = _section(detector, "pixel_pitch", f"{where}: detector")
    p_u, p_v = (_constant(pitch, k, n, "mm", f"{where}: detector.pixel_pitch") for k in "uv")
    n_u, n_v = (_constant(detector, k, n, "px", f"{where}: detector") for k in ("columns", "rows"))
    settled = Given(
        n_u=given.settle("n_u", int(n_u), where),
        n_v=given.settle("n_v", int(n_v), where),
        p_u=given.settle("p_u", p_u, where),
        p_v=given.settle("p_v", p_v, where),
        pose_id=given.pose_id,
    )
    stage, panel = parts["stage"], parts["detector"]
    R_W = np.stack([-stage.axes[:, :, 0], -stage.axes[:, :, 1], stage.axes[:, :, 2]], axis=1)

    def to_W(x: Array) -> Array:
        return (R_W @ x[..., None])[..., 0]

    return matrices_of_panels(
        to_W(parts["source"].centre - stage.centre),
        to_W(panel.centre - stage.centre),
        p_u * to_W(panel.axes[:, :, 0]),
        -p_v * to_W(panel.axes[:, :, 1]),
        given=settled,
        rows="bottom",
        where=where,
    )


@dataclass(frozen=True)
class _Files:
    """Files that a scenario names, relative to its folder."""

    folder: Path | None

    def filled(self, part: Any) -> Any:
        """The same JSON with each drift's file read into its `value`."""
        if isinstance(part, list):
            return [self.filled(p) for p in part]
        if not isinstance(part, Mapping):
            return part
        filled = {k: self.filled(v) for k, v in part.items()}
        name = filled.get("file")
        name = name.get("value") if isinstance(name, Mapping) else name
        if isinstance(name, str) and name and filled.get("value") is None:
            filled["value"] = self._column(name)
        return filled

    def _column(self, name: str) -> list[float]:
        """The first column of a drift file."""
        path = (self.folder or Path()) / PureWindowsPath(name).as_posix()
        try:
            lines = path.read_text(encoding="utf-8-sig").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise FileError(
                f"the scenario names the drift file {name}, which cannot be read: {error}", path=path
            ) from error
        rows = [line for line in lines if line.strip() and not line.lstrip().startswith("#")]
        words = [re.split(r"[\s,;]+", line.strip())[0] for line in rows]
        try:
            return [float(w) for w in words]
        except ValueError as error:
            raise InputError(f"{path}: a drift value is not a number: {error}") from error


def stage_angles(acquisition: Mapping[str, Any], n: int, where: str) -> Array:
    """(n,), rad: the stage's turn about w, evenly from start to stop; positive for direction CCW."""
    start, stop = (_constant(acquisition, k, n, "rad", f"{where}: acquisition") for k in ("start_angle", "stop_angle"))
    direction, final = acquisition.get("direction", "CCW"), acquisition.get("include_final_angle")
    if direction not in ("CCW", "CW"):
        raise InputError(f"{where}: acquisition.direction is {direction!r}; 'CCW' or 'CW' is needed")
    if stop < start:
        raise InputError(f"{where}: acquisition.stop_angle lies before start_angle; the sense is given by 'direction'")
    if stop > start and not isinstance(final, bool):
        raise InputError(f"{where}: acquisition.include_final_angle is {final!r}; true or false is needed")
    steps = n - 1 if final else n
    angle = float_array(start + np.arange(n) * ((stop - start) / steps if steps else 0.0))
    return -angle if direction == "CW" else angle


@dataclass(frozen=True, kw_only=True)
class _Pose:
    """Centre (n, 3), mm, and axes (n, 3, 3) with columns u, v, w, in the scenario's world."""

    centre: Array
    axes: Array


def _part(geo: Mapping[str, Any], n: int, where: str, turn: Array | None) -> _Pose:
    _known(geo, ("center", "centre", "vector_u", "vector_w", "deviations"), where)
    centre_json = _section(geo, "centre" if "centre" in geo else "center", where)
    if not all(k in centre_json for k in "xyz"):  # null coordinates are there
        raise InputError(f"{where}.center has no x, y, z; parts attached to the stage are not read")
    base, drift = _vector(centre_json, "xyz", n, "mm", f"{where}.center")
    directions: dict[str, Array] = {}
    for name in ("vector_u", "vector_w"):
        vector, moved = _vector(_section(geo, name, where), "xyz", n, "", f"{where}.{name}")
        if moved.any():
            raise InputError(f"{where}.{name} drifts; its meaning beside deviations is not settled, it is not read")
        directions[name] = vector
    axes = np.repeat(
        _right_handed(directions["vector_u"], directions["vector_w"], where, "vector_u", "vector_w")[None], n, axis=0
    )
    if turn is not None:
        axes = axes @ R_z(turn)
    pose = _Pose(centre=np.repeat(base[None], n, axis=0), axes=axes)
    for k, deviation in enumerate(_list(geo.get("deviations"), f"{where}.deviations")):
        if deviation is None or deviation.get("amount", 0) is None:
            continue  # null: not relevant
        pose = _deviate(pose, deviation, n, f"{where}.deviations[{k}]")
    return _Pose(centre=pose.centre + drift, axes=pose.axes)


def sample_pose(position: Mapping[str, Any], where: str) -> tuple[Array, Array]:
    """(centre (3,), mm, axes (3, 3) with columns r, s, t) of a sample on the stage, in the stage's coordinates u, v, w.

    The centre is that of the sample's bounding box along its own axes. Deviations turn or shift it about the stage's
    axes (u, v, w) or its own (r, s, t) as they then are; whether a reconstruction knows them does not matter here.
    InputError for a sample that is fixed to the world, and for drifts.
    """
    _known(position, ("center", "centre", "vector_r", "vector_t", "deviations"), where)
    directions = []
    for name, entry in (("center", position.get("centre") or position.get("center")), *(
        (name, position.get(name)) for name in ("vector_r", "vector_t"))):  # fmt: skip
        if not (isinstance(entry, Mapping) and all(k in entry for k in "uvw")):
            raise InputError(f"{where}.{name} is not given along u, v, w; samples must be on the stage")
        vector, drift = _vector(entry, "uvw", 1, "mm" if name == "center" else "", f"{where}.{name}")
        if drift.any():
            raise InputError(f"{where}.{name} drifts; samples that move on the stage are not read")
        directions.append(vector)
    centre, r, t = directions
    pose = _Pose(centre=centre[None], axes=_right_handed(r, t, where, "vector_r", "vector_t")[None])
    for k, deviation in enumerate(_list(position.get("deviations"), f"{where}.deviations")):
        if deviation is None or deviation.get("amount", 0) is None:
            continue  # null: not relevant
        pose = _deviate(pose, deviation, 1, f"{where}.deviations[{k}]", world="uvw", own=("rst",))
    return pose.centre[0], pose.axes[0]


def _right_handed(u: Array, w: Array, where: str, name_u: str, name_w: str) -> Array:
    """(3, 3), columns u, w x u, w of length 1; InputError where u and w are no directions at right angles."""
    for name, vector in ((name_u, u), (name_w, w)):
        if not np.linalg.norm(vector) > 0:
            raise InputError(f"{where}.{name} has length 0")
    u, w = u / np.linalg.norm(u), w / np.linalg.norm(w)
    if abs(u @ w) > 1e-6:
        raise InputError(f"{where}: {name_u} and {name_w} are not at right angles (cosine {u @ w:.3g})")
    return np.stack([u, np.cross(w, u), w], axis=-1)


def _deviate(
    pose: _Pose,
    deviation: Mapping[str, Any],
    n: int,
    where: str,
    *,
    world: str = "xyz",
    own: tuple[str, ...] = ("uvw", "rst"),
) -> _Pose:
    """The pose after one deviation: a shift along, or a turn about, an axis of the world or of the part itself.

    world, own: the letters of the coordinates that the pose is in, and of the part's own axes.
    """
    _known(deviation, ("type", "axis", "pivot", "amount", "known_to_reconstruction"), where)
    if not _is_known(deviation, where):
        return pose
    kind = deviation.get("type")
    if kind not in ("rotation", "translation"):
        raise InputError(f"{where}.type is {kind!r}; 'rotation' or 'translation' is needed")
    if "amount" not in deviation:
        raise InputError(f"{where} has no amount")
    value, drift = _values(deviation["amount"], n, "rad" if kind == "rotation" else "mm", f"{where}.amount")
    amount = value + drift
    axis = deviation.get("axis")
    if isinstance(axis, str) and len(axis) == 1 and axis in "xyzuvwrst":
        axis = {k: float(k == axis) for k in next(s for s in ("xyz", "uvw", "rst") if axis in s)}
    direction, letters = _free_vector(axis, n, "", f"{where}.axis", (world, *own))
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    if not length.min() > 0:
        raise InputError(f"{where}.axis has length 0")
    direction = direction / length
    if letters in own:
        direction = (pose.axes @ direction[..., None])[..., 0]
    if kind == "translation":
        return _Pose(centre=pose.centre + amount[:, None] * direction, axes=pose.axes)
    pivot = pose.centre
    if deviation.get("pivot") is not None:
        pivot, letters = _free_vector(deviation["pivot"], n, "mm", f"{where}.pivot", (world, *own))
        if letters in own:
            pivot = pose.centre + (pose.axes @ pivot[..., None])[..., 0]
    R = exp_rotation(amount[:, None] * direction)
    return _Pose(centre=pivot + (R @ (pose.centre - pivot)[..., None])[..., 0], axes=R @ pose.axes)


def _free_vector(json: Any, n: int, kind: str, where: str, known: Sequence[str]) -> tuple[Array, str]:
    """(n, 3) and the letters of the axes that it is written in, one of `known`."""
    for names in known:
        if isinstance(json, Mapping) and all(k in json for k in names):
            base, drift = _vector(json, names, n, kind, where)
            return base + drift, names
    raise InputError(f"{where} is {json!r}; components along {' or '.join(', '.join(k) for k in known)} are needed")


def _vector(json: Mapping[str, Any], names: str, n: int, kind: str, where: str) -> tuple[Array, Array]:
    """The standard vector (3,) and its drift (n, 3)."""
    _known(json, tuple(names), where)
    missing = [k for k in names if k not in json]
    if missing:
        raise InputError(f"{where} lacks {', '.join(missing)}")
    values = [_values(json[k], n, kind, f"{where}.{k}") for k in names]
    return np.array([value for value, _ in values]), np.stack([drift for _, drift in values], axis=-1)


def _values(json: Any, n: int, kind: str, where: str) -> tuple[float, Array]:
    """A parameter's standard value (null is 0) and the sum of its drifts (n,), in mm, rad, px or without unit."""
    if not isinstance(json, Mapping):
        json = {"value": json}
    _known(json, ("value", "unit", "drifts"), where)
    value = json.get("value")
    value = 0.0 if value is None else float(numbers(value, (), where)) * _unit(json, kind, where, zero=value == 0)
    total = np.zeros(n)
    for k, drift in enumerate(_list(json.get("drifts"), f"{where}.drifts")):
        place = f"{where}.drifts[{k}]"
        _known(drift, ("value", "unit", "known_to_reconstruction", "file"), place)
        if not _is_known(drift, place):
            continue
        if drift.get("value") is None:
            continue  # null: not relevant
        factor = _unit({"unit": json.get("unit"), **drift}, kind, place, zero=False)
        steps = factor * numbers(_list(drift["value"], place, alone=(int, float)), (-1,), place)
        if not len(steps):
            raise InputError(f"{place} has no values")
        # One scan long, whatever the number of values; a scan of one frame takes the first.
        at = np.arange(n) if len(steps) == n else np.linspace(0, len(steps) - 1, n)
        total += np.interp(at, np.arange(len(steps)), steps)
    return value, total


def _constant(json: Mapping[str, Any], name: str, n: int, kind: str, where: str) -> float:
    entry = json.get(name)
    if entry is None or (isinstance(entry, Mapping) and entry.get("value") is None):
        raise InputError(f"{where}.{name} is missing")
    value, drift = _values(json[name], n, kind, f"{where}.{name}")
    if drift.any():
        raise InputError(f"{where}.{name} drifts; one value for the whole scan is needed")
    return value


def _unit(json: Mapping[str, Any], kind: str, where: str, *, zero: bool) -> float:
    unit = json.get("unit") or ""
    if kind and not unit and zero:
        return 1.0
    if not isinstance(unit, str) or unit not in UNITS[kind]:
        known = ", ".join(u for u in UNITS[kind] if u) or "no unit"
        raise UnitError(f"{where}: unit is {unit or 'missing'!r}; needed is one of: {known}")
    return UNITS[kind][unit]


def _is_known(json: Mapping[str, Any], where: str) -> bool:
    known = json.get("known_to_reconstruction")
    if known not in (None, True, False):
        raise InputError(f"{where}.known_to_reconstruction is {known!r}; true or false is needed")
    return known is not False


def _list(json: Any, where: str, *, alone: Any = Mapping) -> list[Any]:
    """A list, of one where a single entry of that kind is alone; none at all is an empty list."""
    if json is None or isinstance(json, list):
        return json or []
    if isinstance(json, alone):
        return [json]
    raise InputError(f"{where} is {json!r}; a list is needed")


def _known(json: Any, keys: Sequence[str], where: str) -> None:
    """InputError names a key that is not read: a misspelt drift must not vanish."""
    if not isinstance(json, Mapping):
        raise InputError(f"{where} is {json!r}; an object is needed")
    unknown = [k for k in json if k not in keys and k not in REMARKS]
    if unknown:
        raise InputError(f"{where}: {unknown[0]!r} is not read here; known are {', '.join(keys)}")


def _section(json: Mapping[str, Any], name: str, where: str) -> Mapping[str, Any]:
    part = json.get(name)
    if not isinstance(part, Mapping):
        raise InputError(f"{where} lacks the section {name!r}")
    return part


def _check_version(content: Mapping[str, Any], where: str) -> None:
    file = _section(content, "file", where)
    if file.get("file_type") != "CTSimU Scenario":
        raise InputError(f"{where}: file.file_type is {file.get('file_type')!r}, not 'CTSimU Scenario'")
    version = _section(file, "file_format_version", f"{where}: file")
    found = (version.get("major"), version.get("minor"))
    if not all(isinstance(x, int) for x in found) or not (1, 0) <= found <= NEWEST:
        raise SchemaVersionError(f"{where}: file format {found[0]}.{found[1]}; 1.0 to 1.2 are read")
