"""A format that cannot hold a geometry says so by name and view; nothing is rounded, nothing vanishes."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from exports_cases import TOLERANCE_PX, pixels, points, random_matrices
from exports_definitions import DEFINITIONS, manifest

from tomopose import Scanner
from tomopose.errors import ConventionError, FileError, InputError, NotRepresentableError
from tomopose.exports import FORMATS, export, read_geometry
from tomopose.geometry.projection import row_flip

X = points(m=6)
ROTATION_ONLY = {"rtk", "tigre", "ctsimu", "thd"}
PLAIN_MATRICES = {"pyronn", "cera", "openct"}


def changed(matrices, view, A):
    P = np.array(matrices.P)
    P[view] = A @ P[view]
    return replace(matrices, P=P)


@pytest.fixture
def mirrored():
    m = random_matrices(11, n=4)
    return changed(m, 2, row_flip(m.n_v))


@pytest.fixture
def skewed():
    return changed(random_matrices(12, n=4), 1, np.array([[1, 1e-4, 0], [0, 1, 0], [0, 0, 1.0]]))


@pytest.fixture
def wrong_aspect():
    return changed(random_matrices(13, n=4), 3, np.diag([1.001, 1, 1]))


@pytest.mark.parametrize("format", sorted(ROTATION_ONLY))
def test_mirrored_images_are_refused_by_name(format, mirrored, tmp_path):
    with pytest.raises(NotRepresentableError, match=rf"{format}.*mirrored.*view 2") as caught:
        export(mirrored, tmp_path / "out", formats=["pyronn", format])
    assert caught.value.format == format
    assert caught.value.indices == (2,)
    assert not (tmp_path / "out").exists()
    assert list(tmp_path.iterdir()) == []


def test_the_other_formats_hold_mirrored_images(mirrored, tmp_path):
    done = export(mirrored, tmp_path / "out")
    assert set(done.refused) == ROTATION_ONLY
    assert set(done.files) == set(FORMATS) - ROTATION_ONLY
    assert manifest(tmp_path / "out")["refused"] == dict(done.refused)
    for name in done.files:
        px = DEFINITIONS[name](tmp_path / "out", X)
        np.testing.assert_allclose(px, pixels(mirrored.P, X), rtol=0, atol=TOLERANCE_PX, err_msg=name)
        back = read_geometry(tmp_path / "out", format=name)
        np.testing.assert_allclose(back.project(X), pixels(mirrored.P, X), rtol=0, atol=TOLERANCE_PX, err_msg=name)


@pytest.mark.parametrize(("case", "word", "view"), [("skewed", "skew", 1), ("wrong_aspect", "aspect", 3)])
def test_only_plain_matrices_hold_skew_and_wrong_aspect(case, word, view, request, tmp_path):
    matrices = request.getfixturevalue(case)
    for format in sorted(set(FORMATS) - PLAIN_MATRICES):
        with pytest.raises(NotRepresentableError, match=rf"{format} .*{word}") as caught:
            export(matrices, tmp_path / "no", formats=[format])
        assert (caught.value.format, caught.value.indices) == (format, (view,))
    done = export(matrices, tmp_path / "out")
    assert set(done.files) == PLAIN_MATRICES
    assert all(word in reason for reason in done.refused.values())
    for name in PLAIN_MATRICES:
        px = DEFINITIONS[name](tmp_path / "out", X)
        np.testing.assert_allclose(px, pixels(matrices.P, X), rtol=0, atol=TOLERANCE_PX, err_msg=name)


def test_values_that_are_not_finite_never_reach_a_file():
    m = random_matrices(14)
    P = np.array(m.P)
    P[1, 0, 3] = np.nan
    with pytest.raises(InputError, match="not finite"):
        replace(m, P=P)


@pytest.mark.parametrize("formats", [["astra", "rkt"], [], "everything"])
def test_unknown_formats_are_refused_with_the_known_ones(formats, tmp_path):
    with pytest.raises(InputError, match="known are astra, rtk, leap"):
        export(random_matrices(15), tmp_path / "out", formats=formats)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("rows", ["up", None])
def test_unknown_row_order(rows, tmp_path):
    with pytest.raises(ConventionError, match="'bottom'"):
        export(random_matrices(15), tmp_path / "out", rows=rows)


def test_nothing_is_overwritten_without_force(tmp_path):
    first, second = random_matrices(16), random_matrices(17)
    export(first, tmp_path / "out")
    before = {p: p.read_bytes() for p in (tmp_path / "out").rglob("*.*")}
    with pytest.raises(FileError, match="exists already"):
        export(second, tmp_path / "out")
    assert {p: p.read_bytes() for p in (tmp_path / "out").rglob("*.*")} == before
    export(second, tmp_path / "out", force=True)
    np.testing.assert_allclose(read_geometry(tmp_path / "out").project(X), second.project(X), rtol=0, atol=TOLERANCE_PX)


def test_the_folder_holds_the_prescribed_files_and_its_manifest_says_what_they_are(tmp_path):
    matrices = random_matrices(18)
    done = export(matrices, tmp_path / "out")
    assert {p.name for p in (tmp_path / "out").iterdir()} == {
        "manifest.json",
        "astra.npy",
        "rtk.xml",
        "rtk.json",
        "leap.npz",
        "tigre.npz",
        "cil.npz",
        "cera.config",
        "cera_projtable.txt",
        "openct.json",
        "ctsimu.json",
        "pyronn.npz",
        "thd",
        "geom.csv",
    }
    content = manifest(tmp_path / "out")
    assert content["schema"] == "tomopose/exports/1"
    assert content["pose_id"] == list(matrices.pose_id)
    assert content["provenance"]["software"] == "tomopose"
    assert list(content["formats"]) == list(FORMATS) == list(done.files)
    for name, entry in content["formats"].items():
        assert tuple(entry["files"]) == done.files[name]
        assert entry["row0"] in ("bottom", "top")
        assert entry["contents"]
        assert entry["load"]


def test_one_format_may_be_named_alone(tmp_path):
    export(random_matrices(19), tmp_path / "out", formats="leap")
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"manifest.json", "leap.npz"}


def test_cera_follows_the_order_of_the_image_files(tmp_path):
    """FlipV says how the files lie on disk, which the scanner knows; the matrices are the same either way."""
    scanner = Scanner(
        d_SD=1200, d_SR=310, p_u=0.2, p_v=0.25, u_0=150, v_0=128, n_u=301, n_v=257, image_rows="bottom-first"
    )
    matrices = replace(random_matrices(20), scanner=scanner)
    export(matrices, tmp_path / "out", formats=["cera"], rows="top")
    assert manifest(tmp_path / "out")["formats"]["cera"]["row0"] == "bottom"
    assert "FlipV = false" in (tmp_path / "out" / "cera.config").read_text()
    np.testing.assert_allclose(DEFINITIONS["cera"](tmp_path / "out", X), matrices.project(X), rtol=0, atol=TOLERANCE_PX)


def test_the_same_geometry_gives_the_same_files(tmp_path):
    for k in "ab":
        export(random_matrices(21), tmp_path / k)
    for name in (str(p.relative_to(tmp_path / "a")) for p in (tmp_path / "a").rglob("*.*")):
        a, b = ((tmp_path / k / name).read_bytes() for k in "ab")
        if name not in ("manifest.json", "cera_projtable.txt"):  # these two carry the time
            assert a == b, name


def test_a_failing_write_leaves_nothing_behind(tmp_path, monkeypatch):
    def full(*_args, **_kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(FileError, match="No space left"):
        export(random_matrices(22), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_sizes_may_be_numpy_numbers(tmp_path):
    """As they come out of an npz; a text file must not say np.float64(0.2)."""
    plain = random_matrices(24)
    matrices = replace(plain, n_u=np.int64(301), n_v=np.float64(257), p_u=np.float64(0.2), p_v=np.float32(0.25))
    export(matrices, tmp_path / "out")
    for name, definition in DEFINITIONS.items():
        np.testing.assert_allclose(
            definition(tmp_path / "out", X), plain.project(X), rtol=0, atol=TOLERANCE_PX, err_msg=name
        )


def test_json_files_are_strict_json(tmp_path):
    export(random_matrices(23), tmp_path / "out")
    for path in (tmp_path / "out").glob("*.json"):
        json.loads(path.read_text(), parse_constant=lambda name: pytest.fail(f"{name} in a JSON file"))
