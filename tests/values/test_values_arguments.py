"""Arguments of every public function: what is of the wrong type, or in another's place, is refused by name."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike

import tomopose as tp
from tomopose import PoseSequence, Scanner
from tomopose.errors import InputError
from tomopose.values import require, require_types
from tomopose.values.arguments import _tests

FUNCTIONS = [name for name in tp.__all__ if inspect.isfunction(getattr(tp, name))]


class Stranger:
    """A value that nothing here is made of."""


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_public_function_refuses_its_first_argument_by_name(name):
    """A value of a class that no function takes, in the place of each required argument; all are wrong at once."""
    function = getattr(tp, name)
    required = [
        p
        for p in inspect.signature(function).parameters.values()
        if p.default is p.empty and p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)
    ]
    if not required:
        function()
        return
    with pytest.raises(InputError) as caught:
        function(**{p.name: Stranger for p in required})
    said = str(caught.value)
    checked = [p.name for p in required if p.name in _tests(inspect.unwrap(function))[1]]
    assert "its path" in said if name.startswith("read_") else said.startswith(f"{checked[0]} must be "), said


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_public_function_checks_every_value_of_this_package_that_it_takes(name):
    """Readers check their path where they open it; every other function is guarded before it begins."""
    function = getattr(tp, name)
    takes_values = any("tomopose" in repr(t) for t in inspect.get_annotations(function, eval_str=False).values())
    if name.startswith("read_") or not takes_values:
        return
    assert _tests(inspect.unwrap(function))[1], f"{name} has no argument that is checked"


def scanner_and_poses():
    scanner = Scanner(d_SD=1200.0, d_SR=310.0, p_u=0.2, p_v=0.25, u_0=733.4, v_0=512.7, n_u=1501, n_v=1203)
    return scanner, PoseSequence.from_table(np.zeros((3, 3)), np.zeros((3, 3)))


def test_arguments_in_the_wrong_order_are_named():
    scanner, poses = scanner_and_poses()
    words = r"^scanner must be a Scanner; a PoseSequence was given: read_scanner\(path\) reads it$"
    with pytest.raises(InputError, match=words):
        tp.calibrate(poses, scanner, None)
    with pytest.raises(InputError, match=r"^path must be a path; a Scanner was given: a str or a Path names a file$"):
        tp.write_scanner(scanner, "scanner.json")


def test_a_path_in_the_place_of_a_value_names_its_reader():
    scanner, _ = scanner_and_poses()
    with pytest.raises(
        InputError, match=r"^poses must be a PoseSequence; a str was given: read_poses\(path\) reads it$"
    ):
        tp.calibrate(scanner, "poses.csv", None)
    with pytest.raises(InputError, match=r"^poses must be a PoseSequence; a list of str was given"):
        tp.calibrate(scanner, ["a.csv", "b.csv"], None)


@require_types
def everything(
    pose: PoseSequence | Sequence[PoseSequence] | None = None,
    path: str | Path = "",
    points: ArrayLike | None = None,
    count: int = 3,
    named: Mapping[str, Scanner] | None = None,
    wave: Callable[[float], float] = abs,
    word: str = "",
    whatever: object = None,
) -> str:
    """Takes one of each kind."""
    return "ran"


def test_what_fits_the_annotations_passes():
    scanner, poses = scanner_and_poses()
    assert everything(poses, Path("a"), [[1, 2]], np.int64(4), {"a": scanner}, np.sin, "x", Stranger()) == "ran"
    assert everything([poses, poses], "a", np.zeros(3), 2.5, {}, abs) == "ran"
    assert everything((), points=7.0) == "ran"


def test_what_can_be_gone_through_only_once_is_not_used_up_by_the_check():
    _, poses = scanner_and_poses()
    once = (p for p in [poses])
    with pytest.raises(InputError, match=r"^pose must be a PoseSequence; a generator was given"):
        everything(once)
    assert len(list(once)) == 1


@pytest.mark.parametrize(
    ("name", "given", "words"),
    [
        ("pose", "x", "pose must be a PoseSequence; a str was given: read_poses"),
        ("pose", ["x"], "pose must be a PoseSequence; a list of str was given"),
        ("path", 3, "path must be a path; an int was given: a str or a Path"),
        ("path", None, "path must be a path; None was given"),
        ("points", "1, 2, 3", "points must be an array of numbers; a str was given$"),
        ("count", Path("3"), "count must be a number; a PosixPath was given$"),
        ("count", None, "count must be a number; None was given$"),
        ("named", {"a": 1}, "named must be a Scanner or mapping; a dict was given"),
        ("wave", 3.0, "wave must be a function; a float was given$"),
        ("word", 3.0, "word must be a str; a float was given$"),
    ],
)
def test_what_does_not_is_refused_before_the_function_runs(name, given, words):
    with pytest.raises(InputError, match=f"^{words}"):
        everything(**{name: given})


def test_a_guarded_function_keeps_its_name_and_signature():
    assert everything.__doc__ == "Takes one of each kind."
    assert list(inspect.signature(everything).parameters)[:2] == ["pose", "path"]


def test_one_value_is_checked_by_hand():
    _, poses = scanner_and_poses()
    with pytest.raises(
        InputError, match=r"^poses must be a PoseSequence; a str was given: read_poses\(path\) reads it"
    ):
        require("poses", "poses.csv", PoseSequence)
    assert require("poses", poses, PoseSequence) is poses
