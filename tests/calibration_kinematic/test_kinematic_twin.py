"""Twin robots: source and detector each on a robot of its own about a fixed ball."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from twin_cases import SCANNER, TwinExperiment, twin_experiment, twin_scan_error

from tomopose import BallObservations, Calibration, projection_matrices
from tomopose.calibration.arrangements.twin_diagnosis import diagnose_twin
from tomopose.calibration.arrangements.twin_robots import calibrate_twin, twin_matrices, view_geometry
from tomopose.calibration.model.twin_projection import twin_blocks, twin_view_matrices
from tomopose.errors import InputError, NotObservableError, ShapeError
from tomopose.geometry.projection import project, project_ball
from tomopose.io.calibration_json import read_calibration, write_calibration
from tomopose.manipulator.inverse import inverse_poses
from tomopose.manipulator.virtual import typical_robot

ROBOT = typical_robot()


@pytest.fixture(scope="module")
def twins() -> TwinExperiment:
    return twin_experiment(ROBOT, 1)


def calibrated(e: TwinExperiment, model: str = "auto", **options: object) -> Calibration:
    return calibrate_twin(
        e.scanner, e.poses, e.observations, twin=e.twin, mount=e.mount, balls={0: e.ball}, model=model, **options
    )


def test_source_that_stays_is_eq6(twins: TwinExperiment) -> None:
    """Where the focal spot stays in its nominal place before the panel, nothing differs from the other arrangement."""
    e = twins
    trusted = e.twin.trusted()
    turned = inverse_poses(e.scan)
    T_HT = e.mount
    spot = (SCANNER.T_WS @ SCANNER.T_TW(0.0) @ T_HT).inv.apply(np.zeros((1, 3)))[0]
    source = replace(e.scan_source, T_MH=replace(e.scan.T_MH, t=e.scan.T_MH.apply(spot)))
    here = replace(e.twin.base, R=np.eye(3), t=np.zeros(3))
    same = replace(trusted, source_poses=source, base=here, focus=np.zeros(3))
    t = np.tile(e.ball, (len(turned), 1))
    b = twin_blocks(SCANNER, same, T_HT=T_HT, poses=turned, p=np.zeros(9), t=t)
    np.testing.assert_allclose(b.x_D, project_ball(SCANNER, T_HT=T_HT, T_MH=turned.T_MH, t=e.ball), atol=1e-9)
    np.testing.assert_allclose(b.source, 0.0, atol=1e-9)


@pytest.mark.slow
def test_derivatives_and_matrices(twins: TwinExperiment) -> None:
    """Jacobians against differences; matrices project the ball where the blocks say."""
    e = twins
    turned = inverse_poses(e.poses.select(slice(0, 5)))
    rng = np.random.default_rng(0)
    m = len(e.twin.names)
    p = rng.standard_normal(m) * np.concatenate([e.twin.sigma[:-9], np.repeat([0.01, 2.0, 1.0], 3)])
    t = np.tile(e.ball, (5, 1))

    def at(p: np.ndarray, t: np.ndarray) -> np.ndarray:
        return twin_blocks(SCANNER, e.twin, T_HT=e.mount, poses=turned, p=p, t=t).x_D

    b = twin_blocks(SCANNER, e.twin, T_HT=e.mount, poses=turned, p=p, t=t)
    for i in range(m):
        h = 1e-6 if e.twin.units[i] == "rad" else 1e-3
        step = h * np.eye(m)[i]
        np.testing.assert_allclose(b.J_p[:, :, i], (at(p + step, t) - at(p - step, t)) / (2 * h), rtol=1e-5, atol=1e-4)
    for i in range(3):
        step = 1e-3 * np.eye(3)[i]
        np.testing.assert_allclose(b.J_t[:, :, i], (at(p, t + step) - at(p, t - step)) / 2e-3, rtol=1e-6, atol=1e-6)
    P = twin_view_matrices(SCANNER, e.twin, T_HT=e.mount, poses=turned, p=p)
    np.testing.assert_allclose(project(P, e.ball[None])[:, 0], b.x_D, atol=1e-8)


@pytest.mark.slow
def test_errors_of_both_robots_are_found(twins: TwinExperiment, tmp_path: Path) -> None:
    e = twins
    rigid, cal = calibrated(e, "rigid"), calibrated(e)
    (before, _), (after, stated) = twin_scan_error(rigid, e), twin_scan_error(cal, e)
    assert (rigid.model, cal.model) == ("rigid", "kinematic")
    assert abs(cal.chi2_dof - 1) < 0.3
    assert after < before / 4
    assert after < 0.06
    assert after < 3 * stated
    write_calibration(tmp_path / "calibration.json", cal)
    again = read_calibration(tmp_path / "calibration.json")
    np.testing.assert_array_equal(
        twin_matrices(again, e.scan, e.scan_source).P, twin_matrices(cal, e.scan, e.scan_source).P
    )
    with pytest.raises(InputError, match="use twin_matrices"):
        projection_matrices(again, e.scan)


@pytest.mark.slow
def test_distance_of_every_view(twins: TwinExperiment) -> None:
    """d_SD and the piercing point follow from the poses of both robots."""
    e = twins
    cal = calibrated(e)
    d_SD, u_0, v_0 = view_geometry(cal, e.poses, e.twin.source_poses)
    assert np.ptp(d_SD) > 10.0, "the robots stray by 15 mm"
    matrices = twin_matrices(cal, e.poses, e.twin.source_poses)
    g = matrices.decompose()
    np.testing.assert_allclose(g.d_SD, d_SD, atol=1e-6)
    np.testing.assert_allclose(np.stack([g.u_0, g.v_0]), np.stack([u_0, v_0]), atol=1e-6)
    assert matrices.points_sigma is not None
    assert matrices.points_sigma_shared is not None
    assert (matrices.points_sigma > matrices.points_sigma_shared).all()


def test_perfect_twins_stay_trusted() -> None:
    e = twin_experiment(ROBOT, 3, size=0.0, n=120)
    cal = calibrated(e)
    assert cal.model == "rigid"
    assert twin_scan_error(cal, e)[0] < 0.03


def test_what_views_cannot_determine_of_the_panel_is_refused(twins: TwinExperiment) -> None:
    """A pitch is found where the views determine it; a prior makes it usable where they do not."""
    e = twins
    rough = BallObservations.from_sigma(e.observations.x_D[:20], 5.0, pose_id=e.observations.pose_id[:20])
    few = replace(e, observations=rough)
    with pytest.raises(NotObservableError, match="these poses determine p_u only to") as error:
        calibrated(few, "rigid", free=("p_u",))
    assert error.value.direction == "p_u"
    held = calibrated(replace(few, scanner=replace(e.scanner, sigma={"p_u": 1e-4, "d_SD": 0.5})), "rigid")
    u = {p.name: p.u for p in held.parameters}
    assert u["p_u"] <= 1e-4
    assert "d_SD" not in u, "it only names a focal spot"


@pytest.mark.slow
def test_starts_of_the_balls_are_found(twins: TwinExperiment) -> None:
    e = twins
    cal = calibrate_twin(e.scanner, e.poses, e.observations, twin=e.twin, mount=e.mount)
    np.testing.assert_allclose(cal.t, calibrated(e).t, atol=1e-5)


def test_wrong_calls_are_refused(twins: TwinExperiment) -> None:
    e = twins
    with pytest.raises(InputError, match="no rotary table"):
        calibrate_twin(
            e.scanner,
            replace(e.poses, alpha=np.ones(len(e.poses))),
            e.observations,
            twin=e.twin,
            mount=e.mount,
            balls={0: e.ball},
        )
    with pytest.raises(InputError, match="ball 0 has none"):
        calibrate_twin(e.scanner, e.poses, e.observations, twin=e.twin, mount=e.mount, balls={})
    with pytest.raises(InputError, match="unknown model"):
        calibrated(e, "magic")
    with pytest.raises(InputError, match="roll and tilt in the mount"):
        calibrate_twin(
            replace(e.scanner, eta=0.01), e.poses, e.observations, twin=e.twin, mount=e.mount, balls={0: e.ball}
        )
    fewer = replace(e.twin, source_poses=e.twin.source_poses.select(slice(0, 50)))
    with pytest.raises(InputError, match="150 of 200 views have no row in the source robot's table"):
        calibrate_twin(e.scanner, e.poses, e.observations, twin=fewer, mount=e.mount, balls={0: e.ball})
    with pytest.raises(ShapeError, match="focus"):
        replace(e.twin, focus=[1.0, 2.0])
    with pytest.raises(InputError, match="base_t_sigma"):
        replace(e.twin, base_t_sigma=0.0)


@pytest.mark.slow
@pytest.mark.parametrize("whose", ["detector", "source"])
def test_a_wrong_reading_of_either_robots_table_is_named(whose: str) -> None:
    e = twin_experiment(ROBOT, 2, n=60, size=0.3)
    assert diagnose_twin(e.scanner, e.poses, e.observations, twin=e.twin, mount=e.mount).as_declared
    table = e.poses if whose == "detector" else e.twin.source_poses
    turned = replace(table.T_MH, R=np.swapaxes(table.T_MH.R, 1, 2))
    wrong = replace(table, T_MH=turned, orientations=None, q=None)
    poses, twin = (wrong, e.twin) if whose == "detector" else (e.poses, replace(e.twin, source_poses=wrong))
    found = diagnose_twin(e.scanner, poses, e.observations, twin=twin, mount=e.mount)
    assert [h.name for h in found.leading] == [f"{whose}: rotation inverted"]
    assert not found.as_declared
