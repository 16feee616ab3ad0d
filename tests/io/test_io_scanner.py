"""scanner.json."""

from __future__ import annotations

import json

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tomopose import Scanner
from tomopose.errors import FileError, InputError, SchemaVersionError, UnitError
from tomopose.io import read_scanner, write_scanner
from tomopose.io.scanner_json import KNOWN, scanner_document, scanner_schema

GOOD = {
    "schema": "tomopose/scanner/1",
    "d_SD_mm": 1500,
    "d_SR_mm": 283.5,
    "p_u_mm": 0.2,
    "p_v_mm": 0.25,
    "u_0_px": 1021.37,
    "v_0_px": 1026.81,
    "n_u_px": 2048,
    "n_v_px": 2047,
}


@pytest.fixture
def file(tmp_path):
    def write(**changes):
        content = {k: v for k, v in (GOOD | changes).items() if v is not ...}
        path = tmp_path / "scanner.json"
        path.write_text(json.dumps(content))
        return path

    return write


def test_the_documented_file_is_read(file):
    s = read_scanner(file())
    assert (s.d_SD, s.d_SR, s.p_u, s.p_v, s.u_0, s.v_0, s.n_u, s.n_v) == (
        1500,
        283.5,
        0.2,
        0.25,
        1021.37,
        1026.81,
        2048,
        2047,
    )
    assert s.image_rows == "top-first"


def test_the_third_party_file_is_read(shared_data):
    assert read_scanner(shared_data / "ball-radiographs-gvxr" / "scanner.json").n_u == 701


@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.builds(
        Scanner,
        d_SD=st.floats(800, 2000),
        d_SR=st.floats(50, 700),
        p_u=st.floats(0.01, 1),
        p_v=st.floats(0.01, 1),
        u_0=st.floats(-5000, 5000),
        v_0=st.floats(-5000, 5000),
        n_u=st.integers(1, 9000),
        n_v=st.integers(1, 9000),
        eta=st.floats(-3, 3),
        theta=st.floats(-0.7, 0.7),
        phi=st.floats(-0.7, 0.7),
        axis_y=st.floats(-5, 5),
        axis_tilt_x=st.floats(-0.1, 0.1),
        axis_tilt_y=st.floats(-0.1, 0.1),
        sigma=st.dictionaries(st.sampled_from(["d_SD", "u_0", "eta"]), st.floats(1e-9, 10)),
        image_rows=st.sampled_from(["top-first", "bottom-first"]),
        certificate=st.text(max_size=20),
    )
)
def test_every_scanner_comes_back_bit_for_bit(tmp_path, scanner):
    write_scanner(tmp_path / "s.json", scanner, force=True)
    assert read_scanner(tmp_path / "s.json") == scanner


def test_every_missing_key_is_named(file):
    for key in GOOD:
        if key != "schema":
            with pytest.raises(InputError, match=f"{key} missing"):
                read_scanner(file(**{key: ...}))


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("d_SD", "'d_SD' has no unit; write 'd_SD_mm'"),
        ("d_SD_m", "'d_SD_m' is in another unit; convert it to 'd_SD_mm'"),
        ("eta_deg", "'eta_deg' is in another unit; convert it to 'eta_rad'"),
        ("n_u", "'n_u' has no unit; write 'n_u_px'"),
    ],
)
def test_a_missing_or_other_unit_is_named(file, key, message):
    with pytest.raises(UnitError, match=message):
        read_scanner(file(**{key: 1}))


def test_an_unknown_key_is_named_with_the_known_ones(file):
    with pytest.raises(InputError, match=r"unknown key 'voltage'; known are: d_SD_mm, .*certificate"):
        read_scanner(file(voltage=120))
    with pytest.raises(InputError, match="sigma: unknown key"):
        read_scanner(file(sigma={"n_q_px": 1}))


@pytest.mark.parametrize("key", ["eta_rad", "theta_rad", "phi_rad"])
def test_degrees_where_radians_belong_are_asked_about(file, key):
    with pytest.raises(UnitError, match=rf"{key} is 0.3, which would be 17.19 deg; is it in degrees"):
        read_scanner(file(**{key: 0.3}))
    assert read_scanner(file(**{key: 0.3, "units": "confirmed"}))
    assert read_scanner(file(**{key: 0.003}))


def test_a_panel_turned_by_a_right_angle_is_fine(file):
    assert read_scanner(file(eta_rad=1.5707963)).eta == 1.5707963


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"p_u_mm": 0.0002}, "p_u_mm is 0.0002; is it in metres"),
        ({"p_v_mm": 200}, "p_v_mm is 200; is it in micrometres"),
        ({"d_SD_mm": 1.5, "d_SR_mm": 0.2835}, "d_SD_mm is 1.5; is it in metres"),
        ({"d_SD_mm": 1.5e6}, "d_SD_mm is 1.5e\\+06; is it in micrometres"),
    ],
)
def test_metres_and_micrometres_are_asked_about(file, changes, message):
    with pytest.raises(UnitError, match=message):
        read_scanner(file(**changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"d_SR_mm": 1500.5}, "not smaller than d_SD"),
        ({"d_SD_mm": -1500}, "d_SD is -1500"),
        ({"p_u_mm": 0}, "p_u is 0"),
        ({"n_u_px": 2048.5}, "whole number of pixels"),
        ({"u_0_px": "1021"}, "u_0_px is '1021'; a number is needed"),
        ({"u_0_px": None}, "a number is needed"),
        ({"u_0_px": True}, "a number is needed"),
        ({"u_0_px": float("nan")}, "not a finite number"),
        ({"sigma": {"d_SD_mm": -1}}, "sigma of d_SD is -1"),
        ({"sigma": 3}, "sigma is no object"),
        ({"image_rows": "upside-down"}, "'top-first' or 'bottom-first' is needed"),
        ({"image_rows": 1}, "text is needed"),
        ({"units": "mm"}, 'only "confirmed" is known'),
    ],
)
def test_impossible_values_are_named(file, changes, message):
    with pytest.raises(InputError, match=message):
        read_scanner(file(**changes))


@pytest.mark.slow
@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.sampled_from([*KNOWN[:-1], "voltage"]),
    st.recursive(
        st.none() | st.booleans() | st.integers(-(10**400), 10**400) | st.floats() | st.text(max_size=3),
        lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.text(max_size=3), inner, max_size=2),
        max_leaves=3,
    ),
)
def test_no_value_makes_the_reader_fail_otherwise_than_on_purpose(tmp_path, key, value):
    path = tmp_path / "scanner.json"
    path.write_text(json.dumps(GOOD | {key: value}))
    found: object = None
    try:
        found = read_scanner(path)
    except (InputError, FileError) as error:
        found = str(error)
    assert isinstance(found, Scanner) or str(path) in str(found)


def test_a_newer_or_foreign_schema_is_refused(file):
    with pytest.raises(SchemaVersionError, match="schema version 2 is newer than 1"):
        read_scanner(file(schema="tomopose/scanner/2"))
    with pytest.raises(SchemaVersionError, match="tomopose/scanner/1"):
        read_scanner(file(schema="tomopose/hexapod/1"))
    with pytest.raises(SchemaVersionError, match="schema is None"):
        read_scanner(file(schema=...))


def test_the_json_schema_knows_the_same_keys(scanner):
    schema = scanner_schema()
    assert set(schema["properties"]) == set(KNOWN)
    assert set(schema["required"]) <= {"schema", *scanner_document(scanner)}


def test_nothing_is_overwritten_without_force(tmp_path, scanner):
    write_scanner(tmp_path / "s.json", scanner)
    with pytest.raises(FileError, match="exists already"):
        write_scanner(tmp_path / "s.json", scanner)
