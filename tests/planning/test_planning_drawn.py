"""Lengths from drawn scans: against SART's own steps, against scans of another generator, and in words."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from test_planning_plan_scan import COARSE, SCANNER, sides
from test_planning_predict import SWEEPS, box_part, plan, task, tilted_turn

import tomopose as tp
from tomopose.errors import InputError
from tomopose.measurement.plan import MeasurementPlan, plan_from
from tomopose.planning.part import drawn
from tomopose.planning.part.drawn import drawn_scans, line_integrals, measured, scatter, scatter_of_place
from tomopose.planning.part.predict import Prediction, predicted
from tomopose.planning.part.sart_steps import planned_scan
from tomopose.planning.part.settings import PartSettings
from tomopose.planning.part.targets import probed_targets
from tomopose.planning.part.worth import Goal, table
from tomopose.planning.part_scan.setting import Setting
from tomopose.reconstruction.settings import SART

POINTS = 60
"""Of a feature: fewer than by default, so that the tests are quick."""


def height() -> MeasurementPlan:
    """The distance of two faces of the box."""
    known = {k: v.model_copy(update={"n_points": POINTS}) for k, v in plan().features.items() if k != "ball"}
    return plan().model_copy(update={"features": known, "measurands": plan().measurands[:1]})


def asked(**changed: object) -> tuple[Setting, Goal, np.ndarray]:
    setting = task(features=height())
    setting = replace(setting, settings=replace(setting.settings, **changed))
    return setting, setting.goal(), tilted_turn(setting)


def foretold(**changed: object) -> Prediction:
    setting, goal, P = asked(**changed)
    return predicted(goal, setting.scanner, P, table(goal, P), plan=setting.features)


@pytest.mark.slow
def test_drawn_scans_scatter_as_the_transposed_steps_say_where_the_noise_is_small():
    """Standard deviations of 60 draws are uncertain by 9 %."""
    small = {"quanta": 2.0e5}
    exact, scans = foretold(uncertainty="exact", **small), foretold(uncertainty="drawn", draws=60, **small)
    assert scans.measured == {"height": 60}
    assert scans.lengths["height"] / exact.lengths["height"] == pytest.approx(1.0, abs=0.25)
    assert [f.name for f in scans.features] == ["top", "bottom"]
    for one, other in zip(scans.features, exact.features, strict=True):
        assert one.u / other.u == pytest.approx(1.0, abs=0.35)


@pytest.mark.slow
def test_drawn_scans_scatter_as_scans_with_another_generators_noise_do():
    """`reconstruct` and `measure` of images whose noise is normal and of the Mersenne twister, at 60 draws each: the
    ratio of two such standard deviations is uncertain by 13 %."""
    setting, goal, P = asked(uncertainty="drawn", draws=60)
    found, matrices, box = planned_scan(goal.part, setting.scanner, P, setting.settings)
    quanta, rng, values = setting.settings.quanta * found.size**2, np.random.RandomState(7), []
    for _ in range(60):
        images = found.tau + np.sqrt(found.tau / quanta) * rng.randn(*found.tau.shape)
        how = {"images_are": "transmission", "engine": "cpu", "consistency": "off"}
        volume = tp.reconstruct(images.astype(np.float32), matrices, box, algorithm=SART(iterations=SWEEPS), **how)
        values.append(tp.measure(volume, height()).results[0].value)
    u = predicted(goal, setting.scanner, P, table(goal, P), plan=setting.features).lengths["height"]
    assert u / np.std(values, ddof=1) == pytest.approx(1.0, abs=0.4)


def test_the_line_integrals_of_a_draw_have_the_mean_and_the_variance_of_their_quanta():
    """20,000 pixels of each transmission: the mean's bias is 1 / (2 N), the variance 1 / N + (r / N)^2, N = N_0 tau."""
    tau = np.repeat([[1.0], [0.2]], 20_000, axis=1)
    p = line_integrals(tau, 2000.0, 30.0, seed=0, draw=3)
    N = 2000.0 * np.array([1.0, 0.2])
    variance = 1 / N + (30.0 / N) ** 2
    np.testing.assert_allclose(p.mean(axis=1), -np.log([1.0, 0.2]) + variance / 2, atol=4 * math.sqrt(1e-2 / 20_000))
    np.testing.assert_allclose(p.var(axis=1), variance, rtol=0.06)
    assert np.array_equal(p, line_integrals(tau, 2000.0, 30.0, seed=0, draw=3))
    assert not np.array_equal(p, line_integrals(tau, 2000.0, 30.0, seed=0, draw=4))
    assert np.isfinite(line_integrals(np.full((1, 9), 1e-9), 100.0, 0.0, seed=0, draw=0)).all()


def test_a_length_that_fewer_than_half_of_the_draws_show_has_no_uncertainty():
    assert scatter(np.array([1.0, 2.0, 3.0, np.nan])) == pytest.approx(1.0)
    assert scatter(np.array([1.0, 2.0, np.nan, np.nan, np.nan])) == math.inf
    assert scatter(np.full(4, np.nan)) == math.inf


def test_the_place_of_a_feature_is_uncertain_along_its_worst_direction(rng):
    """Places across an axis: 3 um along (0.6, 0.8) and 1 um across it."""
    bore = {"kind": "cylinder", "point": [0, 0, 0], "direction": [0, 0, 1], "radius_mm": 3.0, "length_mm": 4.0}
    rows = [{"name": "D", "kind": "diameter", "of": ["bore"]}]
    content = {"schema": "tomopose/measurement-plan/1", "unit": "mm", "features": {"bore": bore}, "measurands": rows}
    target = probed_targets(plan_from(content), 40)[0]
    turned = np.array([[0.6, 0.8], [-0.8, 0.6]])
    x = (rng.normal(size=(4000, 2)) * [0.003, 0.001]) @ turned
    assert scatter_of_place(target, x) == pytest.approx(0.003, rel=0.05)
    x[:2500, 0] = np.nan
    assert scatter_of_place(target, x) == math.inf


def test_what_a_volume_does_not_show_is_left_out_and_the_rest_is_measured():
    """A face far above the box is in no volume of it: neither the face nor a distance to it is found."""
    setting, goal, P = asked(uncertainty="drawn", draws=10)
    volume = next(drawn._volumes(goal, setting.scanner, P))
    far = height().features["top"].model_copy(update={"point": (0.0, 0.0, 40.0)})
    beyond = height().measurands[0].model_copy(update={"name": "beyond", "of": ("far", "bottom")})
    asks = height().model_copy(
        update={"features": {**height().features, "far": far}, "measurands": (*height().measurands, beyond)}
    )
    features, values = measured(volume, asks)
    assert sorted(features) == ["bottom", "top"]
    assert sorted(values) == ["height"]
    assert values["height"] == pytest.approx(8.0, abs=0.5)
    assert values["height"] == tp.measure(volume, height()).results[0].value


def test_the_same_seed_gives_the_same_draws_on_any_number_of_threads(monkeypatch):
    setting, goal, P = asked(uncertainty="drawn", draws=10)

    def values() -> np.ndarray:
        scans = drawn_scans(goal, setting.scanner, P, plan=setting.features, progress=said.append)
        return scans.lengths["height"]

    said: list[str] = []
    found = []
    for threads in (1, 3):
        monkeypatch.setattr(drawn, "processors", lambda threads=threads: threads)
        found.append(values())
    assert np.array_equal(*found)
    assert said[0].startswith("drawn scans: 1 of 10, ")
    assert said[9] == "drawn scans: 10 of 10"


def test_an_interrupted_prediction_starts_no_further_draws(monkeypatch):
    setting, goal, P = asked(uncertainty="drawn", draws=200)
    begun: list[int] = []

    def counted(*given: object, draw: int, **how: object) -> np.ndarray:
        begun.append(draw)
        return line_integrals(*given, draw=draw, **how)

    monkeypatch.setattr(drawn, "processors", lambda: 2)
    monkeypatch.setattr(drawn, "line_integrals", counted)
    volumes = drawn._volumes(goal, setting.scanner, P)
    next(volumes)
    volumes.close()
    assert len(begun) <= 5


def test_without_features_single_points_of_the_surface_are_drawn():
    setting, _, P = asked(uncertainty="drawn", draws=10)
    goal = replace(setting, features=None).goal()
    found = predicted(goal, setting.scanner, P, table(goal, P))
    assert found.lengths == {}
    assert 0 < found.features[0].u < 0.3
    assert math.isnan(found.features[0].u_size)


def test_a_beam_hardens_and_one_energy_does_not():
    L = np.array([0.0, 10.0, 40.0, -1.0])
    beam = ((0.25, 0.2), (0.75, 0.05))
    tau = PartSettings(mu=0.1, beam=beam).transmission(L)
    np.testing.assert_allclose(tau, 0.25 * np.exp([0, -2.0, -8.0, 0]) + 0.75 * np.exp([0, -0.5, -2.0, 0]))
    np.testing.assert_allclose(PartSettings(mu=0.1).transmission(L), np.exp([0, -1.0, -4.0, 0]))


@pytest.mark.slow
def test_a_plan_says_how_many_draws_show_each_length():
    how = {"views": 6, "mu_per_mm": 0.05, "scanner": SCANNER, "features": sides(), "options": COARSE}
    found = tp.plan_scan(box_part().mesh, **how, uncertainty="drawn", draws=10)
    assert found.document["constants"]["uncertainty"] == "drawn"
    assert found.document["constants"]["draws"] == 10
    (width,) = found.document["lengths"]
    assert width["u_mm"] == found.u_mm["width"]
    assert width["draws_measured"] == 10
    assert width["relative_u_of_u"] == pytest.approx(1 / math.sqrt(18))


def test_another_way_or_too_few_draws_are_refused():
    how = {"views": 6, "mu_per_mm": 0.05, "scanner": SCANNER}
    with pytest.raises(InputError, match="uncertainty is 'guessed'; filters, exact, drawn"):
        tp.plan_scan(box_part().mesh, **how, uncertainty="guessed")
    with pytest.raises(InputError, match="draws is 3; a whole number from 10"):
        tp.plan_scan(box_part().mesh, **how, uncertainty="drawn", draws=3)
