"""One table of rules: each holds for every model and arrangement that it names, and the documentation shows it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tomopose.calibration.checks.conventions.hypothesis import Diagnosis, Hypothesis
from tomopose.calibration.checks.evidence.evidence import (
    AgainstRigid,
    BallSize,
    Evidence,
    ScatterFound,
    Undistinguished,
)
from tomopose.calibration.checks.rule import ARRANGEMENTS, MODELS
from tomopose.calibration.checks.rules import RULES, findings, rules_table
from tomopose.calibration.checks.score_tests.ranking import Explanation, Ranked, Single
from tomopose.calibration.checks.score_tests.scanner_tests import ScannerTests
from tomopose.calibration.checks.stability import Effect, OutlierBlock, RepeatedPose, Stability
from tomopose.calibration.checks.verdict import VERDICTS, Finding, judge
from tomopose.calibration.model.budget import Halves
from tomopose.calibration.rigid.contradiction import Contradicted

DOCS = Path(__file__).resolve().parents[2] / "docs" / "concepts" / "verdict.md"
CASES = [(rule, model, arrangement) for rule in RULES for model in rule.models for arrangement in rule.arrangements]


def clean(model: str = "rigid", arrangement: str = "moving-object") -> Evidence:
    """A run in which nothing is wrong, and everything was looked at."""
    identified = model != "rigid"
    return Evidence(
        model=model,
        arrangement=arrangement,
        converged=True,
        finite=True,
        dof=369,
        n_used=189,
        outliers=(),
        misfit=False,
        chi2=372.0,
        chi2_dof=1.01,
        widened=not identified,
        residual_px=0.0207,
        expected_px=0.0205,
        spread_px=300.0,
        scan_px=None if arrangement == "twin" else 0.01,
        stated_px=None if arrangement == "twin" else 0.1,
        diagnosis=diagnosis(factor=1.0, delta=40.0, outcome="worse"),
        stability=Stability(
            effects=(Effect(name="drift", p=0.3, size_px=0.004, share=0.01, words="the ball drifts"),),
            repeats=(RepeatedPose(first="0", again="188", distance_px=0.02, sigmas=1.0),),
            held_out_rms=0.0213,
            held_out_chi2=1.03,
            fit_rms=0.0207,
        ),
        scatter=ScatterFound(ratio=1.0, t_mm=5e-4, w_rad=1.2e-5) if identified else None,
        against_rigid=AgainstRigid(chosen_px=0.021, rigid_px=0.5, better=True) if identified else None,
        size=1.0 if identified else None,
        ball_size=BallSize(ratio=1.001, diameter=8.0),
    )


def diagnosis(*, factor: float, delta: float, outcome: str) -> Diagnosis:
    declared, other = (
        Hypothesis(
            name=name,
            words=name,
            remedy="# convention: other",
            sigmas=1.2,
            d_rms=0.001,
            chi2=chi2,
            dof=369,
            delta=d,
            factor=f,
            outcome=o,
        )
        for name, chi2, d, f, o in (("declared", 372.0, 0.0, 1.0, "declared"), ("zyx", 360.0, delta, factor, outcome))
    )
    return Diagnosis(hypotheses=(other, declared))


def with_readings(*, declared: Mapping[str, Any] = {}, other: Mapping[str, Any] = {}) -> Diagnosis:
    """A clean diagnosis whose readings differ in these values."""
    two, one = diagnosis(factor=1.0, delta=40.0, outcome="worse").hypotheses
    return Diagnosis(hypotheses=(replace(two, **other), replace(one, **declared)))


def test_a_silhouette_that_agrees_with_millimetres_settles_the_unit():
    e = clean()
    doubt = with_readings(other={"outcome": "same", "length_factor": 10.0, "ball_mm": 300.0})
    assert findings(replace(e, diagnosis=doubt)) == ()
    assert [f.rule for f in findings(replace(e, diagnosis=doubt, ball_size=None))] == ["unit of the positions"]


def moved(e: Evidence, *, at: str) -> dict[str, Any]:
    assert e.stability is not None
    effect = Effect(name="mount", p=1e-9, size_px=0.4, share=0.9, words="the mount changed", at=at)
    return {"stability": replace(e.stability, effects=(effect,))}


def repeat(e: Evidence) -> Stability:
    assert e.stability is not None
    return replace(e.stability, repeats=(RepeatedPose(first="0", again="188", distance_px=2.0, sigmas=70.0),))


def explained(name: str, kind: str, at: str = "") -> Explanation:
    return Explanation(name=name, words=name, evidence=40.0, share=0.9, size=np.ones(1), kind=kind, at=at)


def run_tests(
    *, left: Explanation | None = None, single: tuple[str, str, float] | None = None, other: str = ""
) -> ScannerTests:
    """Tests of a run: what is left beside everything assumed; a scanner value of that size and another effect which
    explain equally well why the declared values do not fit."""
    kind, size = ("convention", 0.5) if other == "pixel origin" else ("manipulator", 1e-3)
    equal = () if single is None else (single, (other, kind, size))
    singles = tuple(Single(name=n, short=n, kind=k, evidence=60.0, size=s) for n, k, s in equal)

    def ranked(chosen: tuple[Explanation, ...]) -> Ranked:
        return Ranked(chosen=chosen, single=singles, chi2=400.0, left=370.0, dof=370)

    beside = ranked(() if left is None else (left,))
    return ScannerTests(beside=beside, declared=ranked(()), gain=60.0, sigma={"d_SR": 0.15})


def test_a_value_within_what_was_assumed_of_it_is_the_likelier_of_two_explanations():
    assert run_tests(single=("d_SR", "scanner", 0.4), other="translation_scale").rivals == ()
    assert [r.name for r in run_tests(single=("d_SR", "scanner", 0.5), other="translation_scale").rivals] == [
        "translation_scale"
    ]


def met(name: str, e: Evidence) -> Mapping[str, Any]:
    """What meets the condition of a rule."""
    assert e.stability is not None
    block = OutlierBlock(first="185", last="188", count=4, p=1e-6)
    return {
        "no optimum": {"converged": False},
        "not finite": {"finite": False},
        "nothing fits": {"residual_px": 40.0},
        "alternative convention, much better": {"diagnosis": diagnosis(factor=3.0, delta=-800.0, outcome="better")},
        "alternative convention, better": {"diagnosis": diagnosis(factor=1.2, delta=-60.0, outcome="better")},
        "place of the ball": {"diagnosis": with_readings(declared={"ball_mm": 5000.0, "possible": False})},
        "unit of the positions": {
            "diagnosis": with_readings(other={"outcome": "same", "length_factor": 10.0, "ball_mm": 300.0}),
            "ball_size": None,
        },
        "many centres do not fit": {"misfit": True},
        "outliers": {"outliers": tuple(str(k) for k in range(28)), "n_used": 161},
        "block of outliers": {
            "outliers": ("185", "186", "187", "188"),
            "stability": replace(e.stability, block=block),
        },
        "set aside": {"outliers": ("3",)},
        "degrees of freedom": {"dof": 7},
        "unexplained residuals": {"chi2_dof": 6.0, "chi2": 6.0 * 369, "residual_px": 0.0507},
        "residuals above the stated uncertainty": {"chi2": 1.5 * 369, "chi2_dof": 1.5, "widened": False},
        "residuals below the stated uncertainty": {"chi2_dof": 0.01},
        "contradicted prior": {"prior_pulls": (("u_0", 0.5), ("v_0", -21.0))},
        "drift": moved(e, at=""),
        "step": moved(e, at="100"),
        "changed during the run": {"tests": run_tests(left=explained("mount step", "step", at="56"))},
        "scanner or manipulator not as modelled": {"tests": run_tests(left=explained("radial distortion", "panel"))},
        "value freed": {"contradicted": (Contradicted(name="d_SR", stated=0.15, off=0.9),)},
        "convention not distinguished": {
            "undistinguished": (Undistinguished(name="order ZYX", words="other angles", remedy="", px=0.9),)
        },
        "halves of the poses": {
            "halves": Halves(
                x_D=np.zeros((1, 2)),
                difference=np.ones((1, 2)),
                sigma=np.ones((1, 2)),
                rms_px=0.3,
                stated_px=0.1,
                p=1e-6,
            )
        },
        "origin of the pixels": {"tests": run_tests(single=("u_0", "scanner", 0.49), other="pixel origin")},
        "two explanations": {"tests": run_tests(single=("d_SR", "scanner", 0.9), other="translation_scale")},
        "repeated pose": {"stability": repeat(e)},
        "repeated pose, set aside": {"stability": repeat(e), "outliers": ("188",)},
        "held-out poses": {"stability": replace(e.stability, held_out_rms=0.09, held_out_chi2=20.0)},
        "uncertainty of a tilted scan": {"scan_px": 0.3},
        "uncertainty with all that is assumed": {"stated_px": 1.1, "stated_words": "1.1 px, of which 0.7 px from eta"},
        "scatter of the poses": {"scatter": ScatterFound(ratio=16.0, t_mm=5e-4, w_rad=1.2e-5)},
        "no better than trusted poses": {"against_rigid": AgainstRigid(chosen_px=0.03, rigid_px=0.02, better=False)},
        "size of the errors": {"size": 7.0},
        "drift or lag of the manipulator": {"run_effects": True},
        "undetermined turns": {"open_turns": "one ball cannot determine the turns"},
        "size of the ball": {"ball_size": BallSize(ratio=1.013, diameter=8.0)},
        "size of the ball, noted": {"ball_size": BallSize(ratio=0.993, diameter=8.0)},
    }[name]


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("arrangement", ARRANGEMENTS)
def test_a_clean_run_is_trustworthy_by_every_model_and_arrangement(model, arrangement):
    assert findings(clean(model, arrangement)) == ()
    assert judge(()) == ("trustworthy", ())


@pytest.mark.parametrize(
    ("rule", "model", "arrangement"), CASES, ids=[f"{r.name}-{m}-{a}".replace(" ", "_") for r, m, a in CASES]
)
def test_every_rule_holds_for_every_model_and_arrangement(rule, model, arrangement):
    e = clean(model, arrangement)
    found = findings(replace(e, **met(rule.name, e)))
    (mine,) = (f for f in found if f.rule == rule.name)
    assert (mine.verdict, mine.limit) == (rule.verdict, pytest.approx(rule.limit, nan_ok=True))
    assert mine.words
    word, reasons = judge(found)
    assert VERDICTS.index(word) >= VERDICTS.index(rule.verdict)
    assert (mine.words in reasons) == (rule.verdict != "trustworthy")


def test_only_the_verdict_of_the_findings_counts_the_worst_first():
    rows = [
        Finding(rule=str(k), value=0.0, limit=0.0, words=verdict, verdict=verdict)
        for k, verdict in enumerate(("trustworthy", "doubtful", "rejected", "doubtful"))
    ]
    assert judge(rows) == ("rejected", ("rejected", "doubtful", "doubtful"))
    assert judge(rows[:1]) == ("trustworthy", ())


@pytest.mark.parametrize("name", ["residual_px", "chi2_dof", "scan_px", "stated_px"])
@pytest.mark.parametrize("model", MODELS)
def test_what_is_not_a_number_passes_no_guard(name, model):
    e = replace(clean(model), **{name: float("nan")})
    assert judge(findings(e))[0] != "trustworthy"


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        ({"chi2_dof": 6.0, "chi2": 6.0 * 369, "residual_px": 0.005, "expected_px": 0.002}, "doubtful"),
        ({"residual_px": 300.0, "spread_px": 1500.0}, "rejected"),
        ({"residual_px": 20.0, "spread_px": 300.0}, "rejected"),
        ({"chi2_dof": 0.01}, "trustworthy"),
    ],
)
def test_no_pass_at_chi2_dof_6_and_rejected_where_nothing_fits(changes, verdict):
    found = findings(replace(clean(), **changes))
    assert found, "a word at least"
    assert judge(found)[0] == verdict


def test_an_alternative_that_identified_errors_explain_is_dropped():
    """Poses that were trusted may prefer another convention where the machine errs; the identified model does not."""
    e = clean("kinematic")
    better = diagnosis(factor=3.0, delta=-800.0, outcome="better")
    assert judge(findings(replace(e, diagnosis=better)))[0] == "rejected"
    assert judge(findings(replace(e, diagnosis=better, residual_px=0.0005, expected_px=0.0005)))[0] == "trustworthy"


def test_a_movement_is_a_symptom_where_the_declared_reading_does_not_fit():
    e = clean()
    shifted = replace(e, **moved(e, at="100"))
    assert [f.rule for f in findings(shifted)] == ["step"]
    assert findings(replace(shifted, diagnosis=with_readings(declared={"sigmas": 400.0}))) == ()


def test_effects_need_a_share_of_chi2_where_residuals_are_not_white():
    e = clean("kinematic")
    assert e.stability is not None
    small = Effect(name="mount", p=1e-9, size_px=0.4, share=0.1, words="the mount changed", at="100")
    e = replace(e, stability=replace(e.stability, effects=(small,)))
    assert [f.rule for f in findings(e)] == ["step"]
    scattered = replace(e, scatter=ScatterFound(ratio=8.0, t_mm=5e-4, w_rad=1.2e-5))
    assert findings(scattered) == ()


def test_the_documentation_shows_the_rules():
    text = DOCS.read_text(encoding="utf-8")
    assert rules_table() in text, (
        f"write the output of tomopose.calibration.checks.rules.rules_table() into {DOCS.name}"
    )
