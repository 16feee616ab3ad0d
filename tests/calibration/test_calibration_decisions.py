"""Decisions of a person: lines of review.jsonl, and the observations that follow from them."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tomopose import BallObservations
from tomopose.calibration.records.decisions import (
    Decision,
    Measured,
    decided,
    from_line,
    read_decisions,
    to_line,
    write_decisions,
)
from tomopose.errors import FileError, InputError, SchemaVersionError, TomoposeError

WHEN = "2026-02-03T04:05:06.789+00:00"


def observations() -> BallObservations:
    x = np.array([[10.25, 20.5], [30.0, 41.0], [np.nan, np.nan]])
    return BallObservations.from_sigma(
        x, [0.02, 0.03, np.nan], pose_id=["a", "b", "c"], seen=[True, True, False],
        status=("ok", "saturated rim", "not found"),
        semi_major=np.array([5.0, 6.0, np.nan]), semi_minor=np.array([4.5, 5.5, np.nan]), angle=np.zeros(3),
        snr=np.array([90.0, 80.0, np.nan]), x_ellipse=x,
    )  # fmt: skip


def decision(pose: str, action: str, **changes) -> Decision:
    o = observations()
    x = o.x_D[o.pose_id.index(pose)]
    judged = None if np.isnan(x).any() else (float(x[0]), float(x[1]))
    return Decision(**{"pose_id": pose, "action": action, "who": "N. Sato", "when": WHEN, "judged": judged, **changes})


NEW = Measured(
    x=[31.5, 40.5], covariance=[[1e-4, 2e-6], [2e-6, 3e-4]], status="ok", x_ellipse=[31.6, 40.6], snr=70.0,
    semi_major=6.5, semi_minor=6.25, angle=0.125,
)  # fmt: skip


def test_without_decisions_the_observations_are_the_same():
    o = observations()
    assert decided(o, ()) is o


def test_a_centre_that_is_left_out_is_not_seen_and_says_who_and_why():
    o = decided(observations(), [decision("a", "leave-out", why="dust on the ball")])
    assert o.seen.tolist() == [False, True, False]
    assert o.status[0] == "left out by N. Sato: dust on the ball"
    np.testing.assert_array_equal(o.x_D[0], [10.25, 20.5])


def test_what_was_accepted_is_seen_only_where_it_was_measured():
    hidden = dataclasses.replace(observations(), seen=[True, False, False])
    o = decided(hidden, [decision("b", "accept"), decision("c", "accept")])
    assert o.seen.tolist() == [True, True, False]
    assert o.status[1] == "saturated rim; accepted by N. Sato"
    assert o.status[2] == "not found"


def test_a_second_measurement_takes_the_place_of_the_first():
    o = decided(observations(), [decision("c", "measure-again", start=(31.0, 40.0), measured=NEW)])
    assert o.seen.tolist() == [True, True, True]
    np.testing.assert_array_equal(o.x_D[2], NEW.x)
    np.testing.assert_array_equal(o.covariance[2], NEW.covariance)
    np.testing.assert_array_equal(o.x_ellipse[2], NEW.x_ellipse)
    assert (o.semi_major[2], o.semi_minor[2], o.angle[2], o.snr[2]) == (6.5, 6.25, 0.125, 70.0)
    assert o.status[2] == "ok; measured again by N. Sato"


def test_the_last_decision_about_a_pose_counts():
    out, back = decision("a", "leave-out"), decision("a", "accept")
    assert decided(observations(), [out, back]).seen[0]
    assert not decided(observations(), [back, out]).seen[0]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"judged": (10.27, 20.5)}, "about another detection"),
        ({"judged": None}, "nothing was measured; here u 10.25"),
        ({"pose_id": "zz"}, "has no observation"),
    ],
)
def test_a_decision_about_another_detection_is_refused(changes, words):
    with pytest.raises(InputError, match=words):
        decided(observations(), [decision("a", "leave-out", **changes)])


def test_rounding_of_another_processor_does_not_matter():
    assert not decided(observations(), [decision("a", "leave-out", judged=(10.2500001, 20.5))]).seen[0]


def test_a_journal_is_read_as_it_was_written(tmp_path):
    made = (
        decision("a", "leave-out", why='two\nlines, \u2028 and "quotes" of Åse'),
        decision("c", "measure-again", start=(31.0, 40.0), measured=NEW),
        decision("b", "accept"),
    )
    write_decisions(tmp_path / "review.jsonl", made)
    lines = (tmp_path / "review.jsonl").read_text(encoding="utf-8").split("\n")
    assert len(lines) == 4
    assert all(json.loads(line)["schema"] == "tomopose/review/1" for line in lines[:3])
    read = read_decisions(tmp_path / "review.jsonl")
    assert [to_line(d) for d in read] == [to_line(d) for d in made]
    np.testing.assert_array_equal(read[1].measured.covariance, NEW.covariance)


@pytest.mark.slow
@given(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.floats(1e-12, 1e3), st.text(max_size=40))
def test_numbers_and_words_come_back_bit_by_bit(u, v, variance, why):
    measured = Measured(x=[u, v], covariance=[[variance, 0.0], [0.0, variance]])
    made = Decision(
        pose_id="p", action="measure-again", who="w", when=WHEN, why=why, start=(v, u), judged=(u, v), measured=measured
    )
    back = from_line(to_line(made), "here")
    assert (back.why, back.start, back.judged) == (why, (v, u), (u, v))
    np.testing.assert_array_equal(back.measured.x, [u, v])
    np.testing.assert_array_equal(back.measured.covariance, measured.covariance)


@pytest.mark.parametrize(
    ("changes", "kind", "words"),
    [
        ({"schema": "tomopose/review/2"}, SchemaVersionError, "tomopose/review/1"),
        ({"action": "delete"}, InputError, "is not one of accept, leave-out, measure-again"),
        ({"who": " "}, InputError, "nobody is named"),
        ({"when": "yesterday"}, InputError, "not a time"),
        ({"when": "2026-02-03T04:05:06"}, InputError, "not a time with its zone"),
        ({"pose_id": 3}, InputError, "pose_id is 3"),
        ({"judged_px": [1.0]}, InputError, "two numbers"),
        ({"judged_px": [1.0, None]}, InputError, "two numbers"),
        ({"judged_px": [float("nan"), 1.0]}, InputError, "two numbers"),
        ({"note": "x"}, InputError, "unknown key 'note'"),
        ({"action": "measure-again"}, InputError, "new measurement"),
        ({"action": "measure-again", "measured": {"x_px": [1, 2]}}, InputError, "line 1"),
        (
            {
                "action": "measure-again",
                "measured": {"x_px": [1, 2], "status": "ok", "covariance_px2": [[1, 2], [2, 1]]},
            },
            InputError,
            "positive definite",
        ),
    ],
)
def test_a_bad_line_is_named(tmp_path, changes, kind, words):
    good = json.loads(to_line(decision("a", "leave-out")))
    path = tmp_path / "review.jsonl"
    path.write_text(json.dumps({**good, **changes}) + "\n", encoding="utf-8")
    with pytest.raises(kind, match=words) as caught:
        read_decisions(path)
    assert "line 1" in str(caught.value)


@pytest.mark.parametrize("text", ["{", "[1]", "3", "null", "[" * 2000, '{"schema": 1}'])
def test_a_line_that_is_no_decision_is_an_error_of_input(tmp_path, text):
    (tmp_path / "review.jsonl").write_text(text + "\n", encoding="utf-8")
    with pytest.raises(TomoposeError, match="line 1"):
        read_decisions(tmp_path / "review.jsonl")


def test_a_journal_that_is_not_there_is_named(tmp_path):
    with pytest.raises(FileError, match=r"review\.jsonl"):
        read_decisions(tmp_path / "review.jsonl")
