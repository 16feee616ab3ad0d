"""Reading foreign geometry: what must be given, what contradicts, what is damaged; always in words, never a number."""

from __future__ import annotations

import json
import re
import shutil

import numpy as np
import pytest
from exports_cases import TOLERANCE_PX, points, random_matrices

from tomopose.errors import (
    ConventionError,
    FileError,
    InputError,
    InputWarning,
    SchemaVersionError,
    TomoposeError,
    UnitError,
)
from tomopose.exports import FORMATS, export, read_geometry
from tomopose.exports.openct import FRAMES, detector_frame

X = points(m=6)
MAIN_FILE = {
    "astra": "astra.npy",
    "rtk": "rtk.xml",
    "leap": "leap.npz",
    "tigre": "tigre.npz",
    "cil": "cil.npz",
    "cera": "cera.config",
    "openct": "openct.json",
    "ctsimu": "ctsimu.json",
    "pyronn": "pyronn.npz",
    "thd": "thd",
    "rx": "geom.csv",
}


@pytest.fixture
def matrices():
    return random_matrices(31, n=5)


@pytest.fixture
def bare(matrices, tmp_path):
    """The files of an export alone, without the manifest that knows their sizes."""
    export(matrices, tmp_path / "bare")
    (tmp_path / "bare" / "manifest.json").unlink()
    return tmp_path / "bare"


def options(matrices, **changes):
    return {"n_u": matrices.n_u, "n_v": matrices.n_v, "p_u": matrices.p_u, "p_v": matrices.p_v, **changes}


def edit(path, change):
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    return path


def replace_text(path, pattern, by, count=1):
    text, found = re.subn(pattern, by, path.read_text(), count=count)
    assert found, f"{pattern} is not in {path.name}"
    path.write_text(text)
    return path


def assert_same(back, matrices):
    np.testing.assert_allclose(back.project(X), matrices.project(X), rtol=0, atol=TOLERANCE_PX)


# -- options ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("format", list(FORMATS))
@pytest.mark.parametrize("named", [True, False])
def test_files_alone_with_all_options(format, named, bare, matrices):
    side = bare / "rtk.json" if format == "rtk" else None
    back = read_geometry(
        bare / MAIN_FILE[format], format=format if named else None, rows="bottom", side=side, **options(matrices)
    )
    assert_same(back, matrices)
    assert back.pose_id == ("0", "1", "2", "3", "4")


@pytest.mark.parametrize(
    ("format", "needs"),
    [
        ("astra", ["n_u", "n_v", "rows"]),
        ("leap", ["n_u", "n_v", "rows"]),
        ("pyronn", ["n_u", "n_v", "p_u", "p_v", "rows"]),
    ],
)
def test_a_missing_option_is_named(format, needs, bare, matrices):
    for name in needs:
        given = {**options(matrices), "rows": "bottom"}
        del given[name]
        with pytest.raises(InputError, match=rf"does not hold {name}; give {name} \(--{name.split('_')[0]}"):
            read_geometry(bare / MAIN_FILE[format], **given)
    assert_same(
        read_geometry(
            bare / MAIN_FILE[format], rows="bottom", **{k: v for k, v in options(matrices).items() if k in needs}
        ),
        matrices,
    )


@pytest.mark.parametrize("format", ["cil", "tigre", "cera", "openct", "ctsimu", "thd"])
def test_formats_that_hold_the_detector_need_no_option(format, bare, matrices):
    assert_same(read_geometry(bare / MAIN_FILE[format]), matrices)


@pytest.mark.parametrize("format", ["cil", "tigre", "cera", "openct", "ctsimu", "rtk", "thd"])
@pytest.mark.parametrize(("name", "value"), [("n_u", 302), ("n_v", 256), ("p_u", 0.201), ("p_v", 0.2)])
def test_an_option_that_contradicts_the_file_is_refused(format, name, value, bare):
    side = bare / "rtk.json" if format == "rtk" else None
    with pytest.raises(InputError, match=rf"^{name} is .* but {value} was given"):
        read_geometry(bare / MAIN_FILE[format], side=side, **{name: value})


@pytest.mark.parametrize(("name", "value"), [("p_u", 0.3), ("p_v", 0.2)])
@pytest.mark.parametrize("format", ["astra", "leap"])
def test_a_pitch_that_the_vectors_contradict(format, name, value, bare, matrices):
    with pytest.raises(InputError, match=f"^{name} is"):
        read_geometry(bare / MAIN_FILE[format], rows="bottom", **options(matrices, **{name: value}))


@pytest.mark.parametrize("format", ["rtk", "tigre"])
def test_formats_with_one_row_order_refuse_the_other(format, bare, matrices):
    side = bare / "rtk.json" if format == "rtk" else None
    with pytest.raises(InputError, match="rows is 'bottom'"):
        read_geometry(bare / MAIN_FILE[format], rows="top", side=side, **options(matrices))


@pytest.mark.parametrize("format", ["cil", "cera", "openct", "ctsimu"])
def test_formats_that_state_their_own_direction_do_not_depend_on_the_row_order(format, bare, matrices):
    for rows in ("top", "bottom"):
        assert_same(read_geometry(bare / MAIN_FILE[format], rows=rows), matrices)


@pytest.mark.parametrize("format", ["astra", "leap", "pyronn"])
def test_the_row_order_matters_where_the_numbers_follow_it(format, matrices, tmp_path):
    export(matrices, tmp_path / "out", formats=[format], rows="top")
    (tmp_path / "out" / "manifest.json").unlink()
    path = tmp_path / "out" / MAIN_FILE[format]
    assert_same(read_geometry(path, rows="top", **options(matrices)), matrices)
    with pytest.raises(ConventionError, match=r"are mirrored, seen from the source; try --rows top"):
        read_geometry(path, rows="bottom", **options(matrices))
    wrong = read_geometry(path, rows="bottom", mirrored=True, **options(matrices))
    np.testing.assert_allclose(
        wrong.project(X)[..., 1], matrices.n_v - 1 - matrices.project(X)[..., 1], rtol=0, atol=TOLERANCE_PX
    )


def test_unknown_format_and_row_order(bare):
    with pytest.raises(ConventionError, match="known are astra"):
        read_geometry(bare / "astra.npy", format="atsra")
    with pytest.raises(ConventionError, match="rows is 'upside-down'"):
        read_geometry(bare / "astra.npy", rows="upside-down")
    with pytest.raises(ConventionError, match="is a file of format rtk, not cera"):
        read_geometry(bare / "rtk.xml", format="cera")
    (bare / "x.txt").write_text("1 2 3")
    with pytest.raises(ConventionError, match="is not a file of format astra"):
        read_geometry(bare / "x.txt", format="astra")


def test_a_format_is_never_guessed_from_thin_air(bare):
    for name, content in (("a.txt", "1 2 3\n4 5 6\n"), ("b.json", '{"matrices": []}')):
        (bare / name).write_text(content)
        with pytest.raises(ConventionError, match="cannot be determined"):
            read_geometry(bare / name)
    np.save(bare / "c.npy", np.zeros((4, 11)))
    with pytest.raises(ConventionError, match="cannot be determined"):
        read_geometry(bare / "c.npy")


# -- the export's own manifest ---------------------------------------------------------------------------------------


def test_nothing_is_typed_twice(matrices, tmp_path):
    export(matrices, tmp_path / "out", rows="top")
    for path in (
        tmp_path / "out",
        tmp_path / "out" / "manifest.json",
        *(tmp_path / "out" / name for name in MAIN_FILE.values()),
    ):
        back = read_geometry(path)
        assert_same(back, matrices)
        assert back.pose_id == matrices.pose_id


def test_options_that_contradict_the_manifest(matrices, tmp_path):
    export(matrices, tmp_path / "out", rows="top")
    with pytest.raises(InputError, match=r"n_u is 301 in .*manifest\.json, but 300 was given"):
        read_geometry(tmp_path / "out" / "astra.npy", n_u=300)
    with pytest.raises(InputError, match="rows is 'top'"):
        read_geometry(tmp_path / "out" / "pyronn.npz", rows="bottom")


def test_a_manifest_speaks_for_its_own_files_only(matrices, tmp_path):
    export(matrices, tmp_path / "out")
    other = random_matrices(32, n=5)
    export(other, tmp_path / "other")
    shutil.copy(tmp_path / "other" / "astra.npy", tmp_path / "out" / "astra.npy")
    for place, options in (
        ("out/astra.npy", {}),
        ("out/astra.npy", {"n_u": 301, "n_v": 257, "rows": "bottom"}),
        ("out", {"format": "astra"}),
    ):
        with pytest.raises(FileError, match="not the file that manifest"):
            read_geometry(tmp_path / place, **options)
    shutil.copy(tmp_path / "other" / "astra.npy", tmp_path / "out" / "elsewhere.npy")
    with pytest.raises(InputError, match="does not hold rows"):
        read_geometry(tmp_path / "out" / "elsewhere.npy")
    back = read_geometry(tmp_path / "out" / "elsewhere.npy", n_u=301, n_v=257, rows="bottom")
    assert_same(back, other)


def test_a_newer_manifest_and_a_missing_format(matrices, tmp_path):
    export(matrices, tmp_path / "out", formats=["leap"])
    with pytest.raises(InputError, match="holds no format 'rtk'; it holds leap"):
        read_geometry(tmp_path / "out", format="rtk")
    edit(tmp_path / "out" / "manifest.json", lambda m: m.update(schema="tomopose/exports/2"))
    with pytest.raises(SchemaVersionError, match="newer"):
        read_geometry(tmp_path / "out")
    with pytest.raises(FileError, match="does not exist"):
        read_geometry(tmp_path / "nowhere.npy")


# -- damaged files ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("format", list(FORMATS))
def test_a_truncated_file_is_refused(format, bare, matrices):
    """Cut anywhere: an error of the tree, never a shorter scan."""
    path = bare / MAIN_FILE[format]
    path = {"cera": bare / "cera_projtable.txt", "thd": bare / "thd" / "view_0.json"}.get(format, path)
    whole = path.read_bytes()
    for part in (0.02, 0.3, 0.7, 0.97):
        path.write_bytes(whole[: int(part * len(whole))])
        with pytest.raises(TomoposeError):
            read_geometry(
                path,
                format=format,
                rows="bottom",
                side=bare / "rtk.json" if format == "rtk" else None,
                **options(matrices),
            )


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_not_finite(value, bare, matrices):
    table = np.load(bare / "astra.npy")
    table[3, 4] = value
    np.save(bare / "astra.npy", table)
    with pytest.raises(InputError, match="not finite"):
        read_geometry(bare / "astra.npy", rows="bottom", **options(matrices))


def test_astra_vectors_that_are_no_scan(bare, matrices):
    table = np.load(bare / "astra.npy")
    for column, change, words in (
        (6, lambda t: t * 1.01, "one positive pitch"),
        (6, lambda t: t * 0.0, "one positive pitch"),
    ):
        bad = table.copy()
        bad[2, column : column + 3] = change(bad[2, column : column + 3])
        np.save(bare / "bad.npy", bad)
        with pytest.raises(InputError, match=words):
            read_geometry(bare / "bad.npy", rows="bottom", n_u=301, n_v=257)
    bad = table.copy()
    bad[1, :3] = bad[1, 3:6] + 7 * bad[1, 6:9]
    np.save(bare / "bad.npy", bad)
    with pytest.raises(InputError, match="view 1 the source lies in the plane"):
        read_geometry(bare / "bad.npy", rows="bottom", n_u=301, n_v=257)
    bad = table.copy()
    bad[4, :6] -= np.tile(2 * bad[4, :3], 2)
    np.save(bare / "bad.npy", bad)
    with pytest.raises(InputError, match="view 4 the world origin"):
        read_geometry(bare / "bad.npy", rows="bottom", n_u=301, n_v=257)


def test_missing_arrays_are_named(bare, matrices):
    arrays = dict(np.load(bare / "leap.npz"))
    del arrays["row_vectors"]
    np.savez(bare / "leap.npz", **arrays)
    with pytest.raises(InputError, match="lacks row_vectors"):
        read_geometry(bare / "leap.npz", rows="bottom", **options(matrices))


def test_npz_files_may_be_json_with_the_same_keys(bare, matrices):
    for name in ("leap", "tigre", "cil", "pyronn"):
        arrays = {k: v.tolist() for k, v in np.load(bare / f"{name}.npz").items()}
        (bare / f"{name}.json").write_text(json.dumps(arrays))
        assert_same(read_geometry(bare / f"{name}.json", rows="bottom", **options(matrices)), matrices)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"n_u": 0}, "n_u is 0"),
        ({"n_u": 10.5}, "n_u is 10.5"),
        ({"n_v": -3}, "n_v is -3"),
        ({"p_u": 0.0}, "p_u is 0.0"),
        ({"p_v": np.nan}, "p_v is nan"),
        ({"p_v": np.inf}, "p_v is inf"),
    ],
)
@pytest.mark.parametrize("format", ["pyronn", "astra", "openct"])
def test_options_that_make_no_sense(format, given, words, bare, matrices):
    with pytest.raises(InputError, match=words):
        read_geometry(bare / MAIN_FILE[format], rows="bottom", **{**options(matrices), **given})


WRONG = (None, "x", 0, -1, [], {}, True, [1, 2, 3], {"value": None}, 1e-300, [[]], "nan", float("inf"))


def damage_json(content, rng):
    """Another value, or none, in one random place."""
    places = []

    def walk(node, place):
        places.append(place)
        items = node.items() if isinstance(node, dict) else enumerate(node[:4]) if isinstance(node, list) else ()
        for key, child in items:
            walk(child, [*place, key])

    walk(content, [])
    *parents, last = places[rng.integers(1, len(places))]
    for key in parents:
        content = content[key]
    if rng.random() < 0.2:
        del content[last]
    else:
        content[last] = WRONG[rng.integers(len(WRONG))]


def damage_bytes(whole, rng):
    data = bytearray(whole)
    for _ in range(rng.integers(1, 4)):
        at = rng.integers(0, len(data))
        if rng.random() < 0.5:
            data[at] = rng.integers(32, 127)
        else:
            del data[at : at + rng.integers(1, 60)]
    return bytes(data)


@pytest.mark.parametrize("file", [*MAIN_FILE.values(), "cera_projtable.txt", "rtk.json", "thd/view_2.json"])
def test_damage_is_an_error_of_the_tree_or_a_whole_geometry(file, bare, matrices):
    """Whatever is in a file: never another exception, never a number that is not finite, never fewer views."""
    rng = np.random.default_rng(len(file))
    file = "thd/view_0.json" if file == "thd" else file
    path, whole = bare / file, (bare / file).read_bytes()
    main = bare / {"cera_projtable.txt": "cera.config", "rtk.json": "rtk.xml"}.get(file, file.split("/")[0])
    format = next(name for name, f in MAIN_FILE.items() if f == main.name)
    refused = 0
    for _ in range(60):
        if path.suffix == ".json" and rng.random() < 0.8:
            path.write_bytes(whole)
            edit(path, lambda content: damage_json(content, rng))
        else:
            path.write_bytes(damage_bytes(whole, rng))
        side = bare / "rtk.json" if format == "rtk" else None
        try:
            back = read_geometry(main, format=format, rows="bottom", side=side, **options(matrices))
        except TomoposeError:
            refused += 1
        else:
            assert np.isfinite(back.P).all()
    assert refused > 5


# -- rtk -------------------------------------------------------------------------------------------------------------


def read_rtk(folder, **given):
    return read_geometry(folder / "rtk.xml", side=folder / "rtk.json", **given)


def test_rtk_needs_size_and_pitch_or_its_side_file(bare, matrices):
    with pytest.raises(InputError, match=r"--p-v-mm missing\).*--side"):
        read_geometry(bare / "rtk.xml", **{k: v for k, v in options(matrices).items() if k != "p_v"})
    with pytest.warns(InputWarning, match="the panel is taken as centred"):
        assert_same(read_geometry(bare / "rtk.xml", **options(matrices)), matrices)
    with pytest.raises(FileError, match="does not exist"):
        read_geometry(bare / "rtk.xml", side=bare / "no.json")


def test_rtk_matrix_and_parameters_are_held_against_each_other(bare):
    text = (bare / "rtk.xml").read_text()
    value = re.findall(r"<SourceOffsetX>(.*?)<", text)[2]
    (bare / "rtk.xml").write_text(text.replace(f"<SourceOffsetX>{value}<", f"<SourceOffsetX>{float(value) + 0.01}<"))
    with pytest.raises(InputError, match="view 2 the matrix and the parameters disagree by"):
        read_rtk(bare)


@pytest.mark.parametrize("part", ["Matrix", "parameters"])
def test_rtk_by_parameters_alone(bare, matrices, part):
    """Files without <Matrix>, and files that state common values once, before the projections."""
    replace_text(bare / "rtk.xml", r"\s*<Matrix>[^<]*</Matrix>", "", count=0)
    if part == "parameters":
        single = random_matrices(33, n=3, fixed=True)
        export(single, bare / "fixed", formats=["rtk"])
        (bare / "fixed" / "manifest.json").unlink()
        path = replace_text(bare / "fixed" / "rtk.xml", r"\s*<Matrix>[^<]*</Matrix>", "", count=0)
        common = re.search(r"<SourceToDetectorDistance>.*?</SourceToDetectorDistance>", path.read_text())[0]
        replace_text(path, r"\s*<SourceToDetectorDistance>.*?</SourceToDetectorDistance>", "", count=0)
        replace_text(path, r"\n  <Projection>", f"\n  {common}\n  <Projection>")
        assert_same(read_rtk(bare / "fixed"), single)
    else:
        assert_same(read_rtk(bare), matrices)


def test_rtk_stacks_that_run_from_the_top(bare, matrices):
    """direction [1, -1] with the origin in the top pixel describes the same panel."""

    def flip(side):
        side["origin"][1] += (matrices.n_v - 1) * matrices.p_v
        side["direction"] = [1, -1, 1]

    edit(bare / "rtk.json", flip)
    assert_same(read_rtk(bare), matrices)
    assert_same(read_rtk(bare, rows="top"), matrices)
    with pytest.raises(InputError, match="rows is 'top'"):
        read_rtk(bare, rows="bottom")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda s: s.pop("origin"), "no 'origin'"),
        (lambda s: s.update(orgin=s.pop("origin")), "unknown key 'orgin'"),
        (lambda s: s.update(directions=s.pop("direction")), "unknown key 'directions'"),
        (lambda s: s.pop("spacing"), "does not hold p_u; give p_u"),
        (lambda s: s.pop("size"), "does not hold n_u; give n_u"),
        (lambda s: s.update(direction=[-1, 1]), "neither"),
        (lambda s: s.update(world_to_rtk=[[1, 0, 0], [0, 1, 0], [0, 0, -1]]), "no proper rotation"),
        (lambda s: s.update(origin=[0, "left"]), "origin of the RTK side file"),
    ],
)
def test_rtk_side_files_that_say_too_little(change, words, bare):
    edit(bare / "rtk.json", change)
    with pytest.raises(InputError, match=words):
        read_rtk(bare)


@pytest.mark.parametrize(
    ("pattern", "by", "error", "words"),
    [
        (r'version="3"', 'version="4"', SchemaVersionError, "version '4'; versions 2 and 3 are read"),
        (r"<RTKThreeD(.*)</RTKThreeDCircularGeometry>", r"<Other></Other>", InputError, "root element"),
        (r"<GantryAngle>[^<]*<", "<GantryAngle>east<", InputError, "GantryAngle"),
        (r"<GantryAngle>([^<]*)</GantryAngle>", r"<GantryAngel>\1</GantryAngel>", InputError, "did you mean"),
        (r"<SourceToIsocenterDistance>", "<SourceToIsocenterDistance>-", InputError, "both must be positive"),
        (r"<Matrix>\s*\S+", "<Matrix>", InputError, "Matrix of view 0"),
        (
            r"<Projection>",
            "<RadiusCylindricalDetector>900</RadiusCylindricalDetector>\n<Projection>",
            InputError,
            "cylinder",
        ),
        (r"<!DOCTYPE RTKGEOMETRY>", '<!DOCTYPE RTKGEOMETRY [<!ENTITY a "b">]>', InputError, "entities"),
    ],
)
def test_rtk_files_that_are_not_read(pattern, by, error, words, bare):
    text, found = re.subn(pattern, by, (bare / "rtk.xml").read_text(), count=1, flags=re.S)
    assert found
    (bare / "rtk.xml").write_text(text)
    with pytest.raises(error, match=words):
        read_geometry(bare / "rtk.xml", format="rtk", side=bare / "rtk.json")


# -- CERA ------------------------------------------------------------------------------------------------------------


def test_a_cera_table_alone(bare, matrices):
    table = bare / "cera_projtable.txt"
    assert_same(read_geometry(table, **options(matrices)), matrices)
    with pytest.raises(InputError, match="does not hold n_u"):
        read_geometry(table)


@pytest.mark.parametrize(
    ("file", "pattern", "by", "error", "words"),
    [
        ("cera.config", r"ProjectionMatrixFilename.*\n", "StartAngle = 0\nScanAngle = 360\n", InputError, "circular"),
        ("cera.config", r"cera_projtable", "other", FileError, "does not exist"),
        ("cera.config", r"NumProjections = 5", "NumProjections = 6", InputError, "6 but the table holds 5"),
        ("cera.config", r"FlipU = false", "FlipU = true", InputError, "FlipU = true"),
        ("cera.config", r"CropBorderLeft = 0", "CropBorderLeft = 10", InputError, "CropBorderLeft = 10"),
        ("cera.config", r"BinningFactor = None", "BinningFactor = 2", InputError, "BinningFactor"),
        ("cera.config", r"NumRows = 257", "NumRows = 257.5", InputError, "no whole number"),
        ("cera.config", r"NumRows = 257", "NumRows = many", InputError, "NumRows"),
        ("cera_projtable.txt", r"version 3", "version 4", SchemaVersionError, "version 4; version 3 is read"),
        ("cera_projtable.txt", r"projtable\.txt", "table", InputError, "first line"),
        ("cera_projtable.txt", r"\n5\n", "\n6\n", InputError, "announces 6 matrices"),
        ("cera_projtable.txt", r"\n5\n", "\n4\n", InputError, "announces 4 matrices"),
        ("cera_projtable.txt", r"@3", "@4", InputError, "'@3' is due"),
        ("cera_projtable.txt", r"(0\.0 0\.0\n\S+) \S+", r"\1", InputError, "has 3 numbers"),
        ("cera_projtable.txt", r"(0\.0 0\.0\n)\S+", r"\1nan", InputError, "not finite"),
    ],
)
def test_cera_files_that_are_not_read(file, pattern, by, error, words, bare):
    replace_text(bare / file, pattern, by)
    with pytest.raises(error, match=words):
        read_geometry(bare / "cera.config", format="cera")


def test_cera_configs_from_windows(bare, matrices):
    (bare / "tables").mkdir()
    shutil.move(bare / "cera_projtable.txt", bare / "tables" / "t.txt")
    replace_text(bare / "cera.config", "cera_projtable.txt", r"tables\\\\t.txt")
    text = (bare / "cera.config").read_text()
    (bare / "cera.config").write_bytes(("\ufeff" + text).replace("\n", "\r\n").encode("utf-8"))
    assert_same(read_geometry(bare / "cera.config"), matrices)


# -- openCT ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("dimension", ["Length", "PixelCount"])
def test_openct_in_every_detector_frame(frame, dimension, bare, matrices):
    """The four corners of the panel fix each frame; typed here from what their names say."""
    m = matrices
    w, h = (m.n_u * m.p_u, m.n_v * m.p_v) if dimension == "Length" else (m.n_u, m.n_v)
    left, right = (-w / 2, w / 2) if "Center" in frame else (0, w)
    bottom, top = {
        "OriginAtDetectorCenter.VerticalAxisRunningDownwards": (h / 2, -h / 2),
        "OriginAtDetectorCenter.VerticalAxisRunningUpwards": (-h / 2, h / 2),
        "OriginAtDetectorTopLeftCorner": (h, 0),
        "OriginAtDetectorBottomLeftCorner": (0, h),
    }[frame]
    A = detector_frame(frame, dimension, n_u=m.n_u, n_v=m.n_v, p_u=m.p_u, p_v=m.p_v)
    np.testing.assert_allclose(A @ [-0.5, -0.5, 1], [left, bottom, 1], atol=1e-12)
    np.testing.assert_allclose(A @ [m.n_u - 0.5, m.n_v - 0.5, 1], [right, top, 1], atol=1e-12)

    def rewrite(content):
        content["projections"] |= {
            "detectorCoordinateFrame": frame,
            "detectorCoordinateDimension": dimension,
            "matrices": (A @ m.P).tolist(),
        }

    assert_same(read_geometry(edit(bare / "openct.json", rewrite)), m)


def test_openct_without_a_detector_takes_the_options(bare, matrices):
    edit(bare / "openct.json", lambda d: d.update(geometry=None))
    assert_same(read_geometry(bare / "openct.json", **options(matrices)), matrices)
    with pytest.raises(InputError, match="does not hold n_u"):
        read_geometry(bare / "openct.json")


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        (lambda d: d["OpenCTJSON"].update(versionMajor=2), SchemaVersionError, "version 2"),
        (lambda d: d["units"].update(length="Inch"), UnitError, "Inch"),
        (lambda d: d.pop("units"), InputError, "lacks the section 'units'"),
        (lambda d: d["projections"].update(detectorCoordinateFrame="Somewhere"), ConventionError, "Somewhere"),
        (lambda d: d["projections"].update(detectorCoordinateDimension="Feet"), ConventionError, "Feet"),
        (lambda d: d["projections"].pop("detectorCoordinateFrame"), ConventionError, "detectorCoordinateFrame"),
        (lambda d: d["projections"].update(numProjections=4), InputError, "numProjections is 4 but there are 5"),
        (lambda d: d["projections"].update(matrices=[]), InputError, "circular"),
        (lambda d: d["projections"]["matrices"][1].pop(), InputError, "matrices"),
        (lambda d: d["geometry"].update(mirrorDetectorAxis="U"), InputError, "mirrorDetectorAxis is 'U'"),
    ],
)
def test_openct_files_that_are_not_read(change, error, words, bare):
    edit(bare / "openct.json", change)
    with pytest.raises(error, match=words):
        read_geometry(bare / "openct.json")


# -- CTSimU ----------------------------------------------------------------------------------------------------------


def stage(content):
    return content["geometry"]["stage"]


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        (lambda d: d["file"]["file_format_version"].update(minor=3), SchemaVersionError, "1.3"),
        (lambda d: d["file"]["file_format_version"].update(major=0), SchemaVersionError, "0.2"),
        (lambda d: d["file"].update(file_type="CTSimU Metadata"), InputError, "file_type"),
        (lambda d: d["acquisition"].update(number_of_projections=2.5), InputError, "number_of_projections is 2.5"),
        (lambda d: d["acquisition"].update(direction="left"), InputError, "direction"),
        (lambda d: d["acquisition"].pop("start_angle"), InputError, "start_angle is missing"),
        (lambda d: d["acquisition"]["stop_angle"].update(value=-5), InputError, "lies before"),
        (
            lambda d: d["acquisition"]["stop_angle"].pop("unit") and d["acquisition"]["stop_angle"].update(value=90),
            UnitError,
            "unit is 'missing'",
        ),
        (lambda d: d["acquisition"].update(pixel_binning={"u": 2, "v": 1}), InputError, "pixel_binning.u is 2"),
        (lambda d: d["geometry"]["source"].update(type="parallel"), InputError, "parallel"),
        (lambda d: stage(d).pop("center"), InputError, "'center'"),
        (lambda d: stage(d).update(center={k: {"value": 0} for k in "uvw"}), InputError, "'u' is not read|attached"),
        (lambda d: stage(d).update(deviation={}), InputError, "'deviation' is not read"),
        (lambda d: stage(d)["center"]["x"].update(unit="inch"), UnitError, "inch"),
        (
            lambda d: stage(d)["center"]["x"].update(drift=stage(d)["center"]["x"].pop("drifts")),
            InputError,
            "'drift' is not read",
        ),
        (lambda d: stage(d)["center"]["x"]["drifts"][0].update(value=None, file="x.csv"), FileError, "x.csv"),
        (lambda d: stage(d)["center"]["x"]["drifts"][0].update(value=[]), InputError, "no values"),
        (lambda d: stage(d)["center"]["x"]["drifts"][0].update(known_to_reconstruction="yes"), InputError, "'yes'"),
        (lambda d: stage(d)["vector_u"]["x"].update(drifts=[{"value": [0, 1]}]), InputError, "vector_u drifts"),
        (lambda d: stage(d).update(vector_w=stage(d)["vector_u"]), InputError, "right angles"),
        (lambda d: stage(d)["deviations"][0].update(type="shear"), InputError, "shear"),
        (lambda d: stage(d)["deviations"][0].update(axis="q"), InputError, "axis is 'q'"),
        (lambda d: stage(d)["deviations"][1]["amount"].update(unit="mm"), UnitError, "rad, deg"),
        (lambda d: stage(d)["deviations"][1].pop("amount"), InputError, "no amount"),
        (lambda d: d["detector"]["columns"].update(drifts=[{"value": [0, 1]}]), InputError, "columns drifts"),
        (lambda d: d.pop("detector"), InputError, "'detector'"),
    ],
)
def test_ctsimu_files_that_are_not_read(change, error, words, bare):
    edit(bare / "ctsimu.json", change)
    with pytest.raises(error, match=words):
        read_geometry(bare / "ctsimu.json", format="ctsimu")


def test_ctsimu_by_hand():
    """A circular scan typed from the format's description: source at 0, stage at x = 310, quarter turns."""
    from tomopose.exports.ctsimu_scenario import from_ctsimu
    from tomopose.exports.panel import Given

    def xyz(*values, unit=None):
        return {k: {"value": v, "unit": unit} for k, v in zip("xyz", values, strict=True)}

    upright = {"vector_u": xyz(0, -1, 0), "vector_w": xyz(1, 0, 0)}
    scenario = {
        "file": {"file_type": "CTSimU Scenario", "file_format_version": {"major": 1, "minor": 2}},
        "geometry": {
            "source": {"center": xyz(0, 0, 0, unit="mm"), **upright},
            "detector": {"center": xyz(1240, 0, 0, unit="mm"), **upright},
            "stage": {"center": xyz(31, 0, 0, unit="cm"), "vector_u": xyz(1, 0, 0), "vector_w": xyz(0, 0, 1)},
        },
        "detector": {
            "columns": {"value": 101},
            "rows": {"value": 81},
            "pixel_pitch": {"u": {"value": 0.2, "unit": "mm"}, "v": {"value": 250, "unit": "um"}},
        },
        "acquisition": {
            "start_angle": {"value": 0, "unit": "deg"},
            "stop_angle": {"value": 360, "unit": "deg"},
            "direction": "CCW",
            "number_of_projections": 4,
            "include_final_angle": False,
        },
    }
    m = from_ctsimu(scenario, Given())
    # Magnification 4: a point 1 mm along +y of W lies 4 mm to the right, one along +z 4 mm up; the object turns
    # counter-clockwise seen from above, so after a quarter turn +x has come to where +y was.
    u, v = 50 + 4 / 0.2, 40 + 4 / 0.25
    np.testing.assert_allclose(m.project([[0, 1, 0]])[0, 0], [u, 40], atol=1e-9)
    np.testing.assert_allclose(m.project([[0, 0, 1]])[:, 0], [[50, v]] * 4, atol=1e-9)
    np.testing.assert_allclose(m.project([[1, 0, 0]])[1, 0], [u, 40], atol=1e-9)
    np.testing.assert_allclose(m.project([[1, 0, 0]])[3, 0], [100 - u, 40], atol=1e-9)
