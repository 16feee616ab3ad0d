"""observations.csv: exact round trips and bad tables."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tomopose import BallObservations
from tomopose.errors import FileError, InputError, UnitError
from tomopose.io import InputWarning, read_observations, write_observations
from tomopose.io.observations_csv import sigma_cell, variance_from_cell

HEAD = "pose_id,u_px,v_px,sigma_u_px,sigma_v_px"
GOOD = f"{HEAD}\n7,100.25,200.5,0.02,0.03\n3,-4,5e2,0.02,0.03\n"
COLUMNS = ("snr", "semi_major", "semi_minor", "angle")


@pytest.fixture
def table(tmp_path):
    def write(text: str):
        path = tmp_path / "observations.csv"
        path.write_text(text)
        return path

    return write


def same(a: BallObservations, b: BallObservations) -> None:
    assert (a.pose_id, a.status, a.image) == (b.pose_id, b.status, b.image)
    np.testing.assert_array_equal(a.seen, b.seen)
    np.testing.assert_array_equal(a.x_D[a.seen], b.x_D[b.seen])
    np.testing.assert_array_equal(a.covariance[a.seen], b.covariance[b.seen])
    for name in (*COLUMNS, "x_ellipse", "ball_id"):
        left, right = getattr(a, name), getattr(b, name)
        assert (left is None) == (right is None)
        if left is not None:
            np.testing.assert_array_equal(left, right)


def test_the_plain_table_is_read_in_its_own_order(table):
    obs = read_observations(table(GOOD))
    assert obs.pose_id == ("7", "3")
    assert obs.seen.all()
    np.testing.assert_array_equal(obs.x_D, [[100.25, 200.5], [-4, 500]])
    np.testing.assert_allclose(obs.sigma, [[0.02, 0.03]] * 2, rtol=1e-15)


def test_everything_comes_back_bit_for_bit(tmp_path, rng):
    n = 40
    A = rng.normal(size=(n, 2, 2)) * 0.02
    seen = rng.random(n) > 0.3
    x_D = np.where(seen[:, None], rng.normal(size=(n, 2)) * 500, np.nan)
    obs = BallObservations(
        x_D=x_D,
        covariance=A @ A.swapaxes(1, 2) + 1e-6 * np.eye(2),
        pose_id=tuple(f"p{k}" for k in range(n)),
        seen=seen,
        status=tuple("ok" if s else "truncated, left" for s in seen),
        image=tuple(f"im {k}.tif" for k in range(n)),
        snr=np.where(seen, rng.random(n), np.nan),
        semi_major=rng.random(n),
        semi_minor=rng.random(n),
        angle=rng.random(n),
        x_ellipse=x_D + 0.01,
        ball_id=np.arange(n) % 3,
    )
    write_observations(tmp_path / "o.csv", obs)
    same(read_observations(tmp_path / "o.csv"), obs)


def test_uncorrelated_observations_need_no_covariance_column(tmp_path):
    obs = BallObservations.from_sigma(np.array([[1.0, 2.0]]), 0.0207)
    write_observations(tmp_path / "o.csv", obs)
    assert "cov_uv" not in (tmp_path / "o.csv").read_text()
    same(read_observations(tmp_path / "o.csv"), obs)


def test_a_ball_id_is_a_whole_number_from_0(table):
    read = read_observations(table(f"{HEAD},ball_id\n7,1,2,0.1,0.1,0\n8,3,4,0.1,0.1,12\n"))
    np.testing.assert_array_equal(read.ball_id, [0, 12])
    np.testing.assert_array_equal(read[1:].ball_id, [12])
    assert read_observations(table(GOOD)).ball_id is None
    for bad in ("-1", "1.5"):
        with pytest.raises(InputError, match=rf"row 1.*ball_id.*{bad} is no whole number from 0"):
            read_observations(table(f"{HEAD},ball_id\n7,1,2,0.1,0.1,{bad}\n"))


@given(st.floats(1e-12, 1e6))
def test_a_variance_survives_being_written_as_a_sigma(variance):
    assert variance_from_cell(sigma_cell(variance)) == variance


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(
        st.tuples(st.floats(-9e3, 9e3), st.floats(-9e3, 9e3), st.floats(1e-4, 10), st.floats(-0.99, 0.99)),
        min_size=1,
        max_size=5,
    )
)
def test_whatever_is_written_is_read(tmp_path, rows):
    r = np.array(rows)
    covariance = np.empty((len(r), 2, 2))
    covariance[:, 0, 0], covariance[:, 1, 1] = r[:, 2] ** 2, (2 * r[:, 2]) ** 2
    covariance[:, 0, 1] = covariance[:, 1, 0] = r[:, 3] * 2 * r[:, 2] ** 2
    obs = BallObservations(x_D=r[:, :2], covariance=covariance, pose_id=tuple(map(str, range(len(r)))))
    write_observations(tmp_path / "o.csv", obs, force=True)
    same(read_observations(tmp_path / "o.csv"), obs)


def test_numbers_written_by_a_numpy_script_are_read(table):
    text = GOOD.replace("100.25", "np.float64(100.25)").replace("0.02", "np.float64(0.02)")
    same(read_observations(table(text)), read_observations(table(GOOD)))


def test_decimal_commas_are_read_with_a_warning(table):
    plain = read_observations(table(GOOD))
    with pytest.warns(InputWarning, match="decimal commas"):
        same(read_observations(table(GOOD.replace(",", ";").replace(".", ","))), plain)


def test_rows_not_seen_may_be_blank(table):
    rows = "0,1,2,0.1,0.1,1,ok\n1,,,,,0,truncated\n2,nan,nan,,,false,lost\n"
    obs = read_observations(table(f"{HEAD},seen,status\n{rows}"))
    assert obs.seen.tolist() == [True, False, False]
    assert obs.status == ("ok", "truncated", "lost")
    assert np.isnan(obs.x_D[1:]).all()


@pytest.mark.parametrize("cell", ["", "nan", "inf", "9999"])
def test_a_row_that_counts_as_seen_needs_numbers(table, cell):
    with pytest.raises(InputError, match=r"row 1 \(line 2\), column u_px"):
        read_observations(table(f"{HEAD},seen\n0,{cell},2,0.1,0.1,1\n"))
    with pytest.raises(InputError, match=r"row 1 \(line 2\), column v_px"):
        read_observations(table(f"{HEAD}\n0,1,{cell},0.1,0.1\n"))


@pytest.mark.parametrize("sigma", ["0", "-0.02"])
def test_a_sigma_that_is_not_positive_is_refused(table, sigma):
    with pytest.raises(InputError, match=r"row 2 .* column sigma_v_px: sigma is .* must be above 0"):
        read_observations(table(f"{HEAD}\n0,1,2,0.1,0.1\n1,1,2,0.1,{sigma}\n"))


def test_a_missing_sigma_is_refused(table):
    with pytest.raises(InputError, match="columns sigma_u_px, sigma_v_px are missing"):
        read_observations(table("pose_id,u_px,v_px\n0,1,2\n"))


def test_unknown_columns_and_units_are_named(table):
    with pytest.raises(UnitError, match="column 'u' has no unit; write 'u_px'"):
        read_observations(table(GOOD.replace("u_px", "u", 1)))
    with pytest.raises(InputError, match=r"column 'colour' is unknown; known are: pose_id, u_px.*cov_uv_px2"):
        read_observations(table(f"{HEAD},colour\n0,1,2,0.1,0.1,red\n"))


def test_duplicate_ids_are_refused(table):
    with pytest.raises(InputError, match=r"observations.csv: pose_id '7' is observed more than once"):
        read_observations(table(GOOD.replace("\n3,", "\n7,")))


def test_a_covariance_larger_than_the_variances_is_refused(table):
    with pytest.raises(InputError, match="not positive definite"):
        read_observations(table(f"{HEAD},cov_uv_px2\n0,1,2,0.1,0.1,0.02\n"))


def test_other_slips_are_named(table, tmp_path):
    with pytest.raises(InputError, match="'maybe' is neither 1 nor 0"):
        read_observations(table(f"{HEAD},seen\n0,1,2,0.1,0.1,maybe\n"))
    with pytest.raises(InputError, match="belong together"):
        read_observations(table(f"{HEAD},u_ellipse_px\n0,1,2,0.1,0.1,1\n"))
    write_observations(tmp_path / "o.csv", read_observations(table(GOOD)))
    with pytest.raises(FileError, match="exists already"):
        write_observations(tmp_path / "o.csv", read_observations(table(GOOD)))
