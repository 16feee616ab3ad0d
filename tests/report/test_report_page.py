"""The report as a document: offline, escaped, complete, with figures that plotly accepts."""

from __future__ import annotations

import dataclasses
import json
import re
from html.parser import HTMLParser

import numpy as np
import plotly.graph_objects as go
import pytest

from tomopose import BallObservations, PoseSequence
from tomopose.calibration.model.budget import ScanBudget
from tomopose.calibration.records.decisions import Decision
from tomopose.calibration.result import ModelComparison, ModelJudgement
from tomopose.errors import FileError, ShapeError
from tomopose.report import calibration_report, matrices_report, observations_report, write_report
from tomopose.report.page import Page, Section, Table, plots_script, render, script_json
from tomopose.report.sections.answers import fit_words

LOADING_ATTRIBUTES = {"src", "href", "srcset", "data", "poster", "action", "xlink:href"}


class _Addresses(HTMLParser):
    """Every address in an attribute that a browser could load or follow."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.policy = ""

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.found += [v for k, v in attrs if k in LOADING_ATTRIBUTES and v]
        if values.get("http-equiv") == "Content-Security-Policy":
            self.policy = values["content"]


def addresses(html: str) -> _Addresses:
    parser = _Addresses()
    parser.feed(html)
    return parser


def figures_of(html: str) -> dict:
    return json.loads(re.search(r'id="figures">(.*?)</script>', html, re.S)[1])


@pytest.fixture(scope="module")
def full(sample, scan):
    calibration, observations, poses = sample()
    return calibration_report(calibration, observations=observations, poses=poses, scan=scan)


def test_a_report_loads_nothing_from_elsewhere(full):
    parser = addresses(full)
    assert parser.found
    assert all(a.startswith(("#", "data:image/png;base64,")) for a in parser.found)
    assert "default-src 'none'" in parser.policy
    assert "http" not in parser.policy
    style = re.search(r"<style>(.*?)</style>", full, re.S)[1]
    assert "url(" not in style
    assert "@import" not in style


def test_the_plotting_script_is_embedded_once_and_small(full):
    assert full.count(plots_script()) == 1
    assert "</script" not in plots_script()
    assert len(full.encode()) < 1_500_000


def test_every_figure_is_valid_and_has_a_place(full):
    figures = figures_of(full)
    assert len(figures) == 15
    for name, figure in figures.items():
        assert f'<div class="plot" id="{name}" role="figure" aria-label="' in full
        assert go.Figure(figure).data  # raises on a property that plotly does not know


def test_every_figure_says_what_it_means_and_what_to_look_for(full):
    captions = re.findall(r"<figcaption>(.*?)</figcaption>", full, re.S)
    assert len(captions) == 15
    for caption in captions:
        meaning, look_for = re.fullmatch(r"(.+?) <em>(.+?)</em>", caption.strip(), re.S).groups()
        assert meaning.endswith(".")
        assert look_for.endswith(".")


def test_the_verdict_comes_first_with_its_reasons(full, sample):
    verdict = full.index('class="verdict good"')
    assert verdict < full.index("none of the checks gave a reason for doubt") < full.index("<section")
    calibration, observations, poses = sample(verdict="doubtful")
    html = calibration_report(calibration, observations=observations, poses=poses)
    verdict = html.index('class="verdict care"')
    assert len(calibration.reasons) == 2
    for reason in calibration.reasons:
        assert verdict < html.index(reason) < html.index("<section")


@pytest.mark.parametrize(("verdict", "tone"), [("doubtful", "care"), ("rejected", "bad")])
def test_other_verdicts_have_another_tone(sample, verdict, tone):
    calibration, observations, poses = sample(verdict=verdict)
    html = calibration_report(calibration, observations=observations, poses=poses)
    assert f'class="verdict {tone}"' in html


def test_numbers_in_the_page_are_those_of_the_calibration(full, sample):
    calibration, _, _ = sample()
    assert f"{calibration.d_rms:.4f} px" in full
    phi = calibration.parameters[0]
    assert f"{phi.u * 1e6:.2f} µrad" in full
    assert f"{2 * phi.u * 1e6:.2f} µrad" in full
    cells = re.findall(r"<td[^>]*>(.*?)</td>", full, re.S)
    for T in (calibration.T_HT, calibration.T_HT.inv):
        assert f"{T.R[0, 1]:.9f}" in cells
        assert f"{T.t[2]:.6f}" in cells
    for pose in calibration.outliers:
        assert pose in cells


def test_a_bare_calibration_says_what_was_not_given(sample):
    calibration, _, _ = sample(turns=(0.0,))
    bare = dataclasses.replace(calibration, provenance=None, hypotheses=(), pivot=None, outliers={}, checks=())
    html = calibration_report(bare, observations=None, poses=None)
    for words in (
        "Provenance: not given",
        "Hypotheses tried: not given",
        "not given (no pose table)",
        "not given (no scan)",
        "Radiographs: not given",
        "Pivot of the controller: not given",
        "No image was set aside",
        "their own rms",
    ):
        assert words in html, words
    assert "t_HT,x and d_SR are exactly degenerate" in html
    assert len(figures_of(html)) == 9


def test_parameters_without_uncertainty_are_not_determinable(sample):
    calibration, observations, poses = sample()
    blind = tuple(dataclasses.replace(p, u=float("nan")) for p in calibration.parameters)
    html = calibration_report(
        dataclasses.replace(calibration, parameters=blind, dof=0), observations=observations, poses=poses
    )
    assert html.count("not determinable") >= 3 * len(blind)
    shown = re.sub(r"<script.*?</script>", "", html, flags=re.S)
    assert not re.search(r"\b(nan|inf)\b", shown, re.I)


def test_images_without_a_ball_are_beside_the_outliers(sample):
    calibration, observations, poses = sample()
    seen = dataclasses.replace(calibration, not_seen={"p999": "no ball found"})
    html = calibration_report(seen, observations=observations, poses=poses)
    assert re.search(r"<td[^>]*>p999</td><td[^>]*>no ball found</td>", html)
    assert f"{len(calibration.outliers) + 1} set aside" in html


def test_a_calibration_without_residuals_is_reported_as_such(sample):
    calibration, observations, poses = sample(verdict="rejected")
    empty = dataclasses.replace(
        calibration, pose_id=(), x_D=np.empty((0, 2)), residuals=np.empty((0, 2)), converged=False, dof=0
    )
    html = calibration_report(empty, observations=observations, poses=poses)
    assert "it ended before poses were fitted" in html
    assert "Not converged:" in html
    assert figures_of(html) == {}


def test_every_manual_decision_is_listed(sample):
    calibration, observations, poses = sample()
    when = "2026-02-03T04:05:06+00:00"
    decisions = (
        Decision(pose_id="p003", action="leave-out", who="A. Meier", when=when, why="bubble <b>", judged=(1.0, 2.0)),
        Decision(pose_id="p004", action="accept", who="A. Meier", when=when, judged=(1.0, 2.0)),
    )
    html = calibration_report(calibration, observations=observations, poses=poses, decisions=decisions)
    rows = re.search(r"Manual decisions</h2>(.*?)</section>", html, re.S)[1]
    cells = re.findall(r"<td[^>]*>(.*?)</td>", rows, re.S)
    assert cells == [
        "p003", "left out", "A. Meier", when, "bubble &lt;b&gt;", "p004", "accepted", "A. Meier", when, "–",
    ]  # fmt: skip
    without = calibration_report(calibration, observations=observations, poses=poses)
    assert "Manual decisions" not in without


@pytest.mark.parametrize(("verdict", "use"), [("trustworthy", "Yes"), ("doubtful", "Not before"), ("rejected", "No: ")])
def test_the_first_screen_answers_four_questions(sample, verdict, use):
    calibration, observations, poses = sample(verdict=verdict)
    html = calibration_report(calibration, observations=observations, poses=poses)
    asked = re.search(r'<dl class="answers">(.*?)</dl>', html, re.S)[1]
    questions = re.findall(r"<dt>(.*?)</dt>", asked)
    words = re.findall(r"<dd>(.*?)</dd>", asked, re.S)
    assert questions == ["Can I use it?", "How exact is it?", "What limits it?", "What would help most?"]
    assert words[0].startswith(use)
    assert all(w.strip().endswith(".") for w in words)
    assert "0.8" in words[1]  # of 0.832 um, the largest uncertainty of the mount


def limiting(html: str) -> str:
    asked = re.search(r'<dl class="answers">(.*?)</dl>', html, re.S)[1]
    return re.findall(r"<dd>(.*?)</dd>", asked, re.S)[2]


@pytest.mark.parametrize(
    ("measured", "shares", "words"),
    [
        (0.2, (("u_0", 0.05), ("d_SR", 0.04)), "The measurement itself: 0.200 px of 0.210 px."),
        (0.002, (("u_0", 0.14), ("d_SR", 0.12), ("d_SD", 0.1)), "most of all u_0 (piercing point, along u): 44 % of"),
    ],
)
def test_what_limits_a_calibration_is_the_larger_part(sample, measured, shares, words):
    calibration, observations, poses = sample()
    budget = ScanBudget(total=0.21, measured=measured, shares=shares)
    html = calibration_report(dataclasses.replace(calibration, budget=budget), observations=observations, poses=poses)
    assert words in limiting(html)


@pytest.mark.parametrize(
    ("chi2", "word"), [(0.979, "Good"), (0.718, "Harmless"), (1.9, "High"), (float("nan"), "No degrees of freedom")]
)
def test_a_value_of_chi2_is_explained(chi2, word):
    assert fit_words(chi2, 743 if np.isfinite(chi2) else 0).startswith(word)


def test_names_cannot_break_out_of_the_page(sample):
    calibration, observations, poses = sample()
    evil = "</script><script>alert(1)</script>"
    ids = (evil, *calibration.pose_id[1:])
    html = calibration_report(
        dataclasses.replace(calibration, pose_id=ids), observations=observations, poses=poses, title=evil
    )
    assert "<script>alert(1)" not in html
    assert evil in figures_of(html)["figure-0"]["data"][0]["text"]


def test_script_json_keeps_values_and_hides_tags():
    text = script_json({"a": "<b>\u2028", "x": np.array([1.0, np.nan])})
    assert "<" not in text
    assert "\u2028" not in text
    assert json.loads(text) == {"a": "<b>\u2028", "x": [1.0, None]}


def test_a_page_without_figures_carries_no_plotting_script():
    table = Table(title="T", meaning="", columns=["a"], rows=[["1"]])
    html = render(Page(title="small", sections=[Section(title="S", blocks=[table])]))
    assert len(html) < 20_000
    assert "const tomoposePlots" not in html


def test_the_same_values_give_the_same_page(sample):
    calibration, observations, poses = sample()
    first = calibration_report(calibration, observations=observations, poses=poses)
    assert calibration_report(calibration, observations=observations, poses=poses) == first


def test_models_stability_and_findings_become_tables(sample):
    calibration, observations, poses = sample(verdict="doubtful")
    rigid = ModelJudgement(
        model="rigid",
        log_evidence=1.0,
        log_predictive=2.0,
        cv_rms=0.0321,
        cv_chi2=1.1,
        d_rms=0.495,
        chi2_dof=1.0,
        scatter=1.0,
        size=1.0,
    )
    models = (rigid, dataclasses.replace(rigid, model="kinematic", d_rms=0.031))
    html = calibration_report(
        dataclasses.replace(calibration, comparison=ModelComparison(models=models, chosen="kinematic")),
        observations=observations,
        poses=poses,
    )
    assert "Models and checks" in html
    assert "kinematic" in html
    assert "0.0321" in html
    assert "What the checks found" in html
    assert "a closing pose would help" in html


def test_observations_report_counts_and_names_what_is_lost(sample):
    _, observations, _ = sample()
    html = observations_report(observations)
    n = len(observations)
    assert f"The ball was measured in {n - 2} of {n} images." in html
    assert html.count("ball truncated by the image border") == 4  # among those not used, and in the table of all
    assert len(figures_of(html)) == 2
    nothing = dataclasses.replace(observations, seen=np.zeros(n, dtype=bool))
    assert f"No ball was measured in any of {n} images." in observations_report(nothing)


def test_a_report_of_very_many_images_stays_small_and_says_what_it_leaves_out(sample):
    calibration, _, poses = sample()
    used = calibration.pose_id
    rows = np.tile(np.arange(len(used)), 6000 // len(used))
    n, worst = len(rows), 4321
    ids = tuple(f"p{k}" for k in range(n))
    residuals = calibration.residuals[rows]
    residuals[worst] = [0.3, 0.0]
    many = dataclasses.replace(calibration, pose_id=ids, x_D=calibration.x_D[rows], residuals=residuals, outliers={})
    seen = BallObservations.from_sigma(many.x_D, 0.02, pose_id=ids)
    place = poses.index_of(used)[rows]
    table = PoseSequence(T_MH=poses.T_MH[place], pose_id=ids, alpha=poses.alpha[place])
    html = calibration_report(many, observations=seen, poses=table)
    assert len(html) < 1.5e6
    assert f"Listed are the worst 500 of {n}; calibration.json (residuals) holds all" in html
    figures = figures_of(html)
    assert html.count(f"Drawn are 500 of {n} poses") >= 6
    by_pose = next(f for f in figures.values() if any(t.get("name", "").startswith("d_rms") for t in f["data"]))
    points = [p for trace in by_pose["data"] for p in trace.get("text", [])]
    assert len(points) == 500
    assert ids[worst] in points
    rms = next(t for t in by_pose["data"] if t.get("name", "").startswith("d_rms"))["y"][0]
    np.testing.assert_allclose(rms, many.d_rms)  # of all poses, not of those drawn
    page = observations_report(seen)
    assert len(page) < 1.5e6
    assert f"Drawn are 500 of {n}, evenly over the run" in page
    assert f"Listed are those without a ball and the most uncertain 500 of {n}; observations.csv holds all" in page


def test_a_report_of_a_usual_run_shows_every_pose(full):
    assert "Drawn are" not in full
    assert "Listed are" not in full


def test_matrices_report_shows_the_source_path(scan):
    html = matrices_report(scan, exports=("astra", "rtk"))
    path = figures_of(html)["figure-0"]["data"][0]
    source = np.column_stack([path[k] for k in "xyz"])
    np.testing.assert_allclose(source, scan.decompose().source, atol=1e-9)
    assert "<li>astra</li>" in html
    without = matrices_report(dataclasses.replace(scan, points_sigma=None))
    assert "not determinable: the matrices hold no uncertainty" in without


def test_reports_are_written_whole_or_not_at_all(tmp_path, full):
    write_report(tmp_path / "r.html", full)
    assert (tmp_path / "r.html").read_text(encoding="utf-8") == full
    (tmp_path / "file").write_text("")
    with pytest.raises(FileError, match="cannot be written"):
        write_report(tmp_path / "file" / "r.html", full)


def test_thumbnails_need_images_for_every_row(sample):
    from tomopose.report import worst_thumbnails

    _, observations, _ = sample()
    with pytest.raises(ShapeError, match="but 1 images"):
        worst_thumbnails(observations, [np.zeros((4, 4))])
