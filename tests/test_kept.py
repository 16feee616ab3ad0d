"""The key of kept work: it changes with everything that the result depends on, and with nothing else."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from enum import Enum

import numpy as np
import pytest

from tomopose.errors import FileError
from tomopose.kept import (
    Key,
    StartsAnewWarning,
    digest_of,
    digest_of_images,
    goes_on,
    key_of,
    write_key,
)


class Rows(Enum):
    TOP = 1
    BOTTOM = 2


@dataclass(frozen=True)
class Ring:
    radius: float
    centre: tuple[float, ...] = (0.0, 0.0)


@dataclass(frozen=True)
class Disc:
    radius: float
    centre: tuple[float, ...] = (0.0, 0.0)


IMAGE = np.arange(300 * 40, dtype=np.uint16).reshape(300, 40)

DIFFERENT = [
    None,
    True,
    1,
    1.0,
    "1",
    b"1",
    0.0,
    -0.0,
    float("nan"),
    1.0000000000000002,
    1 + 0j,
    Rows.TOP,
    Rows.BOTTOM,
    [],
    [1],
    [1, 2],
    [2, 1],
    [[1], 2],
    [1, [2]],
    {1, 2},
    {},
    {"a": 1},
    {"a": 1.0},
    {"b": 1},
    {"a": {"b": 1}},
    Ring(1.0),
    Ring(1.0, (0.0, 1e-300)),
    Disc(1.0),
    np.arange(4),
    np.arange(4).reshape(2, 2),
    np.arange(4, dtype=np.int32),
    np.arange(4, dtype=np.float64),
    np.arange(4) > 2,
    np.zeros(0),
    np.zeros((0, 3)),
]


def test_different_values_have_different_digests():
    digests = [digest_of(value) for value in DIFFERENT]
    assert len(set(digests)) == len(DIFFERENT)
    assert digests == [digest_of(value) for value in DIFFERENT]


def test_equal_values_have_one_digest_whatever_holds_them():
    assert digest_of({"a": 1, "b": [2.5]}) == digest_of({"b": (2.5,), "a": 1})
    assert digest_of({3, 1, 2}) == digest_of(frozenset([2, 3, 1]))
    assert digest_of(np.float64(0.1)) == digest_of(0.1)
    assert digest_of(np.int16(7)) == digest_of(7)
    assert digest_of(IMAGE[::-1][::-1]) == digest_of(np.asfortranarray(IMAGE)) == digest_of(IMAGE)


def test_one_pixel_of_any_row_changes_the_key():
    found = {digest_of(IMAGE)}
    for row in range(len(IMAGE)):
        other = IMAGE.copy()
        other[row, 17] += 1
        found |= {digest_of(other), digest_of_images([IMAGE, other])}
    assert len(found) == 1 + 2 * len(IMAGE)


def test_the_order_and_number_of_images_belong_to_the_key():
    a, b = IMAGE, IMAGE + np.uint16(1)
    assert len({digest_of_images(s) for s in ([], [a], [a, b], [b, a], [a, a], [a.astype("f4")])}) == 6


def test_a_path_is_the_content_of_its_file_and_not_its_name(tmp_path):
    for name, content in (("a", "x"), ("b", "x"), ("c", "y")):
        (tmp_path / name).write_text(content)
    assert digest_of(tmp_path / "a") == digest_of(tmp_path / "b") != digest_of(tmp_path / "c")
    before = digest_of(tmp_path)
    (tmp_path / "c").rename(tmp_path / "d")
    assert digest_of(tmp_path) != before
    with pytest.raises(FileError, match="nowhere"):
        digest_of(tmp_path / "nowhere")


@pytest.mark.parametrize("value", [print, object(), np.array([object()]), iter([1]), int])
def test_a_value_without_a_canonical_form_is_refused(value):
    with pytest.raises(TypeError, match="canonical form"):
        digest_of({"inside": [value]})


def test_the_key_holds_the_versions_of_what_calculates(monkeypatch):
    key = key_of("state", seed=1)
    assert {"version of tomopose", "version of numpy", "seed"} <= set(key.parts)
    monkeypatch.setattr("tomopose.kept.package_version", lambda name: "0.0.1")
    older = key_of("state", seed=1)
    assert older != key
    assert any("version of tomopose was" in change for change in key.changes(older))


def test_the_key_survives_its_file_and_names_what_differs(tmp_path):
    settings = {"relaxation": 0.8, "order": "golden"}
    key = key_of("checkpoint", P=IMAGE, settings=settings, ring=Ring(2.0), mask=None)
    write_key(tmp_path / "key.json", key)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert goes_on(tmp_path / "key.json", key, what="the checkpoint")
        assert not goes_on(tmp_path / "absent.json", key, what="the checkpoint")
    other = key_of("checkpoint", P=IMAGE.T, settings={**settings, "relaxation": 0.5}, ring=Ring(2.5), mask=IMAGE > 3)
    assert other.digest != key.digest
    with pytest.warns(StartsAnewWarning) as said:
        assert not goes_on(tmp_path / "key.json", other, what="the checkpoint in runs/a")
    text = str(said[0].message)
    assert "the checkpoint in runs/a" in text
    assert "starts anew" in text
    for words in ("P changed", "settings.relaxation was 0.8, now 0.5", "ring.radius was 2.0, now 2.5", "mask changed"):
        assert words in text
    assert "order" not in text


@pytest.mark.parametrize("text", ["", "{", "[]", '{"schema": "tomopose/key/1"}', '{"schema": "tomopose/key/9"}'])
def test_a_damaged_key_starts_anew(tmp_path, text):
    (tmp_path / "key.json").write_text(text)
    with pytest.warns(StartsAnewWarning, match="no readable key"):
        assert not goes_on(tmp_path / "key.json", key_of("state"), what="the state")


def test_another_kind_of_work_is_never_continued():
    assert key_of("a").changes(key_of("b")) == ("it is a b, not a a",)
    assert key_of("a") != key_of("b")
    assert Key.from_json(key_of("a", x=1).to_json()) == key_of("a", x=1)
