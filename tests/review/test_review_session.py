"""A review as a value: what a decision changes, and what it must not."""

from __future__ import annotations

import json

import numpy as np
import pytest

import tomopose as tp
from tomopose.calibration.records.decisions import Measured, read_decisions
from tomopose.errors import DetectionError, InputError
from tomopose.files import plain
from tomopose.review.app import Desk
from tomopose.review.crops import LARGEST_HALF, crop
from tomopose.review.session import begin, decision_about, measured_again, predicted_centres
from tomopose.review.view import residual_lengths, rows_view, state_view, worst_first


@pytest.fixture
def review(project):
    observations = tp.read_observations(project.folder / "observations.csv")
    scanner, poses = tp.read_scanner(project.folder / "scanner.json"), tp.read_poses(project.folder / "poses.csv")
    solves = []

    def solve(o):
        solves.append(o)
        return tp.calibrate(scanner, poses, o)

    begun = begin(observations, poses, (), solve)
    return begun, solves


def test_the_worst_detections_come_first(review, project):
    begun, _ = review
    first = worst_first(begun)[: len(project.spoilt)]
    assert sorted(begun.detected.pose_id[k] for k in first) == list(project.spoilt)
    _, d = residual_lengths(begun)
    assert (np.diff(d[worst_first(begun)]) <= 0).all()


def test_predictions_are_observed_minus_residual(review):
    begun, _ = review
    cal = begun.calibration
    predicted = predicted_centres(cal, begun.poses)[begun.poses.index_of(cal.pose_id)]
    np.testing.assert_allclose(predicted, cal.x_D - cal.residuals, atol=1e-6)
    assert np.isfinite(predicted_centres(cal, begun.poses)).all()


def test_a_decision_is_solved_again_and_undo_brings_everything_back(review):
    begun, solves = review
    k = worst_first(begun)[0]
    out = begun.with_decision(decision_about(begun, k, "leave-out", who="w"))
    assert begun.detected.pose_id[k] not in out.calibration.outliers
    assert out.calibration.not_seen[begun.detected.pose_id[k]] == "left out by w"
    assert len(solves) == 2
    back = out.without_last()
    assert back.decisions == ()
    np.testing.assert_array_equal(back.calibration.T_HT.matrix, begun.calibration.T_HT.matrix)
    with pytest.raises(InputError, match="no decision to undo"):
        back.without_last()


def test_what_changes_nothing_is_not_solved_again(review):
    begun, solves = review
    k = worst_first(begun)[-1]
    accepted = begun.with_decision(decision_about(begun, k, "accept", who="w"))
    assert len(solves) == 1
    assert accepted.calibration is begun.calibration
    assert rows_view(accepted)[k]["decision"] == "accept"


def test_a_ball_is_measured_again_from_a_given_start(project):
    scanner = tp.read_scanner(project.folder / "scanner.json")
    images = tp.open_images(project.folder / "radiographs", scanner)
    calibration = tp.read_calibration(project.cal / "calibration.json")
    poses = tp.read_poses(project.folder / "poses.csv")
    true = predicted_centres(calibration, poses)[0]
    found = measured_again(images, 0, scanner, ball_diameter=8.0, start=(true[0] + 9.0, true[1] - 7.0))
    assert isinstance(found, Measured)
    np.testing.assert_allclose(found.x, true, atol=0.1)  # px; the calibration's own uncertainty is below 0.05
    with pytest.raises(DetectionError, match=r"measured again from u 20\.0"):
        measured_again(images, 0, scanner, ball_diameter=8.0, start=(20.0, 20.0))


def test_a_crop_is_the_part_of_the_image_about_the_ball(project):
    import json

    scanner = tp.read_scanner(project.folder / "scanner.json")
    images = tp.open_images(project.folder / "radiographs", scanner)
    for centre, half in (((255.0, 244.0), 20), ((3.0, 2.0), 40), ((511.4, 488.2), 40), ((250.0, 240.0), 10_000)):
        found = crop(images, 0, centre, half)
        head = json.loads(found.head)
        pixels = np.frombuffer(found.pixels, dtype="<u2").reshape(head["height"], head["width"])
        u0, v0 = head["u0"], head["v0"]
        assert head["kind"] == "uint16"
        np.testing.assert_array_equal(pixels, images[0][v0 : v0 + head["height"], u0 : u0 + head["width"]])
        assert max(pixels.shape) <= 2 * LARGEST_HALF + 1


@pytest.fixture
def desk(review, tmp_path):
    return Desk(review=review[0], journal=tmp_path / "review.jsonl", who="N. Sato", save=lambda r: [])


def test_a_decision_adds_a_line_and_sends_only_what_changed(desk):

    def take(row: int, action: str) -> dict:
        decision = desk.decision({"row": row, "action": action})
        return desk.take(lambda r: r.with_decision(decision))

    assert set(take(3, "accept")["rows"]) == {"3"}
    used = len(desk.review.calibration.pose_id)
    node = desk.journal.stat().st_ino
    accepted = take(4, "accept")
    assert desk.journal.stat().st_ino == node  # one line more, not another file
    assert set(accepted["rows"]) == {"4"}
    assert "result" not in accepted
    assert [d["pose"] for d in accepted["decisions"]] == ["p004"]
    solved = take(5, "leave-out")
    assert len(solved["rows"]) == len(desk.review.detected)
    assert "outline" in solved["rows"]["5"]
    assert "outline" not in solved["rows"]["6"]  # no solve changes what was detected
    assert solved["result"]["used"] == used - 1
    undone = desk.take(lambda r: r.without_last())
    assert (undone["keep"], undone["decisions"]) == (2, [])
    assert read_decisions(desk.journal) == desk.review.decisions


def test_a_page_that_follows_the_changes_shows_the_whole_state(desk):
    shown = state_view(desk.review)
    for row, action in ((3, "accept"), (7, "leave-out"), (3, "leave-out"), (-1, "undo"), (9, "accept"), (-1, "undo")):
        decision = None if action == "undo" else desk.decision({"row": row, "action": action})
        found = desk.take(lambda r, d=decision: r.without_last() if d is None else r.with_decision(d))
        rows = [{**old, **found["rows"].get(str(k), {})} for k, old in enumerate(shown["rows"])]
        decisions = [*shown["decisions"][: found["keep"]], *found["decisions"]]
        shown = {"rows": rows, "result": found.get("result", shown["result"]), "decisions": decisions}
        assert json.dumps(plain(shown)) == json.dumps(plain(state_view(desk.review)))


def test_a_journal_that_another_changed_is_written_anew(desk):
    for row in (3, 4):
        decision = desk.decision({"row": row, "action": "accept"})
        desk.take(lambda r, d=decision: r.with_decision(d))
        desk.journal.unlink()
    decision = desk.decision({"row": 5, "action": "accept"})
    desk.take(lambda r: r.with_decision(decision))
    assert [d.pose_id for d in read_decisions(desk.journal)] == ["p003", "p004", "p005"]
