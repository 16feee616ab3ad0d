"""Arguments of the public functions: a value of the wrong type, or in another's place, is refused by name.

`@require_types` reads a function's own annotations.  It checks classes of this package, paths, words, functions, None,
and lists or mappings of them; of numbers and arrays it says only what cannot be one (a word, a path, a value of this
package).  Their shapes, signs and units are left to the function, which knows them.
"""

from __future__ import annotations

import inspect
import os
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, wraps
from itertools import islice
from typing import ParamSpec, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike

from tomopose.errors import InputError
from tomopose.values.images import Images

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")

MADE_BY = {
    "array of numbers": "",
    "function": "",
    "mapping": "",
    "number": "",
    "sequence": "",
    "path": "a str or a Path names a file",
    "str": "",
    "BallObservations": "read_observations(path) reads it, detect(images, scanner, ball_diameter=...) makes it",
    "Calibration": "read_calibration(path) reads it, calibrate(scanner, poses, observations) makes it",
    "Hexapod": "read_manipulator(path) reads it",
    "ImageSequence": "open_images(path) reads it",
    "MeasurementPlan": "read_plan(path) reads it",
    "Mesh": "read_mesh(path) reads it",
    "PoseSequence": "read_poses(path) reads it",
    "ProjectionMatrices": "read_matrices(path) reads it, projection_matrices(calibration, poses) makes it",
    "RigidTransform": "RigidTransform.from_angles(angles, t, source=..., target=...) makes it",
    "Scanner": "read_scanner(path) reads it",
    "Scene": "read_scene(path) reads it",
    "SerialRobot": "read_manipulator(path) reads it",
    "SimulatedRun": "simulate(scene) makes it",
    "TwinRobots": "read_twin(path) reads it",
    "Volume": "read_volume(path) reads it, reconstruct(...) makes it",
}
"""Name of a type -> how one gets a value of it; others by their own name."""

MILLIMETRES = ("ball_diameter", "d_SD", "radius", "spacing")
"""Arguments whose unit a caller may have in mind wrongly: the refusal names it."""

Test = Callable[[object], bool]
ARRAY_LIKE = typing.get_args(ArrayLike)
CALLABLE: object = Callable


def require(name: str, given: object, kind: type[T] | tuple[type[T], ...], *, made_by: str | None = None) -> T:
    """The argument, if it is of that type.

    Raises InputError that names the argument, what was given, and how one gets the right type: "poses must be a
    PoseSequence; a str was given: read_poses(path) reads it".
    """
    kinds = kind if isinstance(kind, tuple) else (kind,)
    if isinstance(given, kinds):
        return given
    raise InputError(_refusal(name, given, tuple(k.__name__ for k in kinds), made_by))


def require_types(function: Callable[P, R]) -> Callable[P, R]:
    """The same function; before anything else it refuses, by `require`'s words, arguments of other types."""

    @wraps(function)
    def guarded(*args: P.args, **kwargs: P.kwargs) -> R:
        signature, tests = _tests(function)
        for name, given in signature.bind(*args, **kwargs).arguments.items():
            if name in tests:
                wanted, holds = tests[name]
                if not holds(given):
                    raise InputError(_refusal(name, given, wanted, None))
        return function(*args, **kwargs)

    return guarded


def _refusal(name: str, given: object, wanted: tuple[str, ...], made_by: str | None) -> str:
    was = "None" if given is None else f"{_article(type(given).__name__)} {type(given).__name__}"
    if isinstance(given, (list, tuple)) and given:
        was += f" of {type(given[0]).__name__}"
    if wanted == ("number",) and name in MILLIMETRES:
        wanted = ("number of mm",)
    how = MADE_BY.get(wanted[0].removesuffix(" of mm"), f"{wanted[0]}(...) makes it") if made_by is None else made_by
    return f"{name} must be {_article(wanted[0])} {' or '.join(wanted)}; {was} was given{': ' if how else ''}{how}"


def _article(word: str) -> str:
    return "an" if word[:1].lower() in "aeiou" else "a"


@cache
def _tests(function: Callable[..., object]) -> tuple[inspect.Signature, dict[str, tuple[tuple[str, ...], Test]]]:
    """The signature, and for each parameter that can be checked: (names of its types, test)."""
    # what a function returns may be of a package that is not installed: only its parameters are looked up
    taken = types.FunctionType(function.__code__, function.__globals__)
    taken.__annotations__ = {name: hint for name, hint in function.__annotations__.items() if name != "return"}
    hints = typing.get_type_hints(taken)
    signature = inspect.signature(function)
    found = {}
    for name, parameter in signature.parameters.items():
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD) or name not in hints:
            continue
        test = _test(hints[name])
        if test is not None:
            found[name] = (tuple(dict.fromkeys(_words(hints[name]))), test)
    return signature, found


def _parts(hint: object) -> tuple[object, ...]:
    """The members of a union, with ArrayLike, itself a union, as one of them."""
    if typing.get_origin(hint) not in (typing.Union, types.UnionType):
        return (hint,)
    parts = typing.get_args(hint)
    if set(ARRAY_LIKE) <= set(parts):
        return (np.ndarray, *(part for part in parts if part not in ARRAY_LIKE))
    return parts


def _test(hint: object) -> Test | None:
    """Whether a value is of a hint's type; None where the hint holds a type that is not checked here."""
    parts = _parts(hint)
    if len(parts) > 1:
        tests = [test for test in map(_test, parts) if test is not None]
        return (lambda value: any(test(value) for test in tests)) if len(tests) == len(parts) else None
    return _test_of_one(parts[0])


def _test_of_one(hint: object) -> Test | None:
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    kind = origin or hint
    if not isinstance(kind, type) or kind is object:
        return None
    if kind is type(None):
        return lambda value: value is None
    if kind is str or issubclass(kind, os.PathLike):
        return lambda value: isinstance(value, (str, os.PathLike))
    if kind in (int, float, np.ndarray):
        return _may_be_numbers
    if kind is bool or _is_ours(kind):
        return lambda value: isinstance(value, kind)
    if kind is CALLABLE:
        return callable
    if issubclass(kind, Mapping) and len(parts) == 2:
        return _each(_test(parts[1]) or (lambda value: True), Mapping)
    if kind is Images or (issubclass(kind, Sequence) and parts):
        item = _test(parts[0]) if parts else _may_be_numbers
        return _may_be_numbers if parts and parts[0] in (int, float) else _each(item, Sequence)
    if kind is Iterable:  # what it holds may be made as it is asked for
        return _holds_items
    return None


def _words(hint: object) -> Iterable[str]:
    """Names for a hint's types, None left out."""
    parts = _parts(hint)
    if any(isinstance(part, type) and issubclass(part, os.PathLike) for part in parts):
        yield "path"
        parts = tuple(part for part in parts if part is not str)
    for part in parts:
        kind, inner = typing.get_origin(part) or part, typing.get_args(part)
        if kind in (int, float):
            yield "number"
        elif kind in (np.ndarray, Images) or (inner and inner[0] in (int, float)):
            yield "array of numbers"
        elif kind is CALLABLE:
            yield "function"
        elif kind is Iterable:
            yield "sequence"
        elif isinstance(kind, type) and issubclass(kind, (Mapping, Sequence)) and kind is not str:
            yield from _words(inner[-1] if issubclass(kind, Mapping) else inner[0])
            if issubclass(kind, Mapping):
                yield "mapping"
        elif isinstance(kind, type) and kind not in (type(None), object) and not issubclass(kind, os.PathLike):
            yield kind.__name__


def _is_ours(kind: type) -> bool:
    return kind.__module__.startswith("tomopose.") and not getattr(kind, "_is_protocol", False)


def _may_be_numbers(value: object) -> bool:
    """False for what cannot be a number or an array of numbers."""
    wrong = isinstance(value, (str, bytes, os.PathLike, Mapping, type, types.NoneType)) or callable(value)
    return not wrong and not type(value).__module__.startswith("tomopose.")


def _holds_items(value: object) -> bool:
    """Whether one can go through a value: an iterable, or what has a length and numbered items."""
    return not isinstance(value, (str, bytes, type)) and (hasattr(value, "__iter__") or hasattr(value, "__getitem__"))


def _each(test: Test | None, container: type) -> Test | None:
    """Whether a value is such a container whose every item passes."""
    if test is None:
        return None

    def holds(value: object) -> bool:
        if isinstance(value, Mapping):
            return container is Mapping and all(map(test, value.values()))
        if container is Mapping or not _holds_items(value) or not hasattr(value, "__len__"):
            return False  # what has no length could be gone through only once
        items = cast(Iterable[object], value)
        if not isinstance(value, (list, tuple)):
            items = islice(items, 1)  # items that are made as they are asked for, such as images: one shows the kind
        return all(map(test, items))

    return holds
