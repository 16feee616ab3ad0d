"""The border: which errors pass, what the others become, and the limits of text, JSON, TOML, arrays and HDF5."""

from __future__ import annotations

import io
import os
import zipfile

import h5py
import numpy as np
import pytest
import tifffile

from tomopose import open_images, read_scanner
from tomopose.errors import FileError, InputError, TomoposeError
from tomopose.io.images.formats.tiff_structure import require_sound_tiff
from tomopose.reading import memory, parse_json, parse_toml, read_text, reader, reading, require_inside
from tomopose.reading.arrays import read_npy, read_npz
from tomopose.reading.border import in_words
from tomopose.reading.child import asked_apart
from tomopose.reading.hdf5 import checked_hdf5


@reader("thing")
def read_thing(path, raised=None):
    if raised is not None:
        raise raised
    return path.read_text()


FOREIGN = [
    (KeyError("joints"), "the entry 'joints' is missing"),
    (IndexError("list index out of range"), "a list in it is too short"),
    (TypeError("int is not iterable"), "of the wrong kind"),
    (AttributeError("no attribute 'get'"), "of the wrong kind"),
    (ZeroDivisionError("division by zero"), "is zero"),
    (OverflowError("too large"), "a number in it is too large"),
    (RecursionError("depth"), "nested too deeply"),
    (MemoryError(), "more memory than is free"),
    (StopIteration(), "ends too early"),
    (EOFError(), "ends too early"),
    (np.linalg.LinAlgError("Singular matrix"), "Singular matrix"),
    (zipfile.BadZipFile("no zip"), "no zip"),
    (NotImplementedError("compression"), "compression"),
    (RuntimeError("odd"), "odd"),
]


@pytest.mark.parametrize(("raised", "words"), FOREIGN)
def test_a_foreign_exception_names_file_kind_and_cause(tmp_path, raised, words):
    (tmp_path / "a.txt").write_text("x")
    with pytest.raises(FileError, match=rf"a\.txt is no readable thing: .*{words}") as found:
        read_thing(tmp_path / "a.txt", raised)
    assert found.value.__cause__ is raised
    assert found.value.path == tmp_path / "a.txt"


@pytest.mark.parametrize("raised", [InputError("ours"), NameError("x"), AssertionError("y"), ImportError("z")])
def test_our_own_errors_and_our_own_faults_pass(tmp_path, raised):
    (tmp_path / "a.txt").write_text("x")
    with pytest.raises(type(raised)) as found:
        read_thing(tmp_path / "a.txt", raised)
    assert found.value is raised


def test_a_wrong_call_is_no_fault_of_the_file(tmp_path):
    (tmp_path / "a.txt").write_text("x")
    with pytest.raises(TypeError, match="unexpected keyword"):
        read_thing(tmp_path / "a.txt", colour=1)
    with pytest.raises(TypeError, match="missing"):
        read_thing()


@pytest.mark.parametrize("path", [5, None, 3.0, ["a"]])
def test_something_that_is_no_path_is_named(path):
    with pytest.raises(InputError, match="was given instead of its path"):
        read_thing(path)


def test_places_that_are_no_files_are_named(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "gone")
    os.mkfifo(tmp_path / "pipe")
    for path, words in (
        ("", "is empty"),
        ("a\0b", "zero byte"),
        (tmp_path / "none", "does not exist"),
        (tmp_path / "link", "link to nothing"),
        (tmp_path, "is a folder; a thing is needed"),
        (tmp_path / "pipe", "device or pipe"),
        ("/dev/zero", "device or pipe"),
        (tmp_path / ("x" * 300), "File name too long"),
        ("/".join(["y" * 200] * 30), "File name too long"),
    ):
        with pytest.raises(FileError, match=words):
            read_thing(path)


def test_a_cause_is_one_short_line():
    assert "\n" not in in_words(ValueError("a\nb"))
    assert len(in_words(ValueError("x" * 10_000))) < 250


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"a": 1, "a": 2}', "the key 'a' occurs twice"),
        ('{"b": {"a": 1, "a": 1}}', "the key 'a' occurs twice"),
        ('{"a": ' + "9" * 309 + "}", "309 digits"),
        ("[" * 65 + "]" * 65, "more than 64 levels"),
        ("[" * 100_000, "more than 64 levels"),
        ('{"a": NaN}', "a is NaN, not a finite number"),
        ('{"a": [[1, -Infinity]]}', "a is -Infinity"),
        ('{"a": 1e999}', "a is 1e999"),
        ("[NaN]", "no finite number"),
        ('{"a": }', "no JSON"),
        ("", "no JSON"),
    ],
)
def test_json_that_is_refused(text, words):
    with pytest.raises(TomoposeError, match=words):
        parse_json(text, "a.json")


def test_json_that_is_read():
    assert parse_json('{"a": [1, 2.5, null, "[[["], "b": {"a": 1e300}}', "a.json") == {
        "a": [1, 2.5, None, "[[["],
        "b": {"a": 1e300},
    }
    assert parse_json("[NaN]", "a.json", constants=True)[0] != 0
    assert parse_json('"' + "[" * 1000 + '\\""', "a.json") == "[" * 1000 + '"'


@pytest.mark.parametrize("text", ["a = ", "a = " + "9" * 400, "a = " + "[" * 3000, "a = 1\na = 2"])
def test_toml_that_is_refused(text):
    with pytest.raises(FileError, match=r"a\.toml"):
        parse_toml(text, "a.toml")


def test_lines_end_alike_on_every_system(tmp_path):
    (tmp_path / "a.txt").write_bytes(b"\xef\xbb\xbfa\r\nb\rc\n")
    assert read_text(tmp_path / "a.txt") == "a\nb\nc\n"


@pytest.mark.parametrize("name", ["../x", "..\\x", "/etc/x", "C:\\x", "a/../../x", "", " ", 5, None, "a\0"])
def test_names_that_leave_their_folder(tmp_path, name):
    with pytest.raises(FileError, match=r"m\.json names"):
        require_inside(tmp_path, name, "m.json")


def test_names_and_links_inside_a_folder(tmp_path):
    (tmp_path / "in").mkdir()
    assert require_inside(tmp_path / "in", "a\\b.txt", "m.json") == tmp_path / "in" / "a" / "b.txt"
    (tmp_path / "in" / "out").symlink_to(tmp_path / "secret")
    with pytest.raises(FileError, match="link that leaves"):
        require_inside(tmp_path / "in", "out", "m.json")


def npy(shape, payload, descr="<f8"):
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": descr, "fortran_order": False, "shape": shape})
    return stream.getvalue() + payload


@pytest.mark.parametrize("shape", [(10**9, 10**9), (2**62,), (3,), (1,)])
def test_arrays_that_claim_another_size_than_they_have(tmp_path, shape):
    (tmp_path / "a.npy").write_bytes(npy(shape, b"\0" * 16))
    with pytest.raises(FileError, match=r"a\.npy: the array of shape .* needs"):
        read_npy(tmp_path / "a.npy", "thing")
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("P.npy", npy(shape, b"\0" * 16))
    with pytest.raises(FileError, match=r"a\.npz: the array 'P' of shape .* needs"):
        read_npz(tmp_path / "a.npz", "thing")


@pytest.mark.slow
def test_a_zip_that_swells_is_refused_before_it_is_unpacked(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_BZIP2) as archive:
        archive.writestr("P.npy", npy((40 * 2**20,), b"\0" * (8 * 40 * 2**20)))
    with pytest.raises(FileError, match=r"only \d+ bytes of the file belong to it"):
        read_npz(tmp_path / "a.npz", "thing")


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_an_array_that_occurs_twice_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        for _ in range(2):
            archive.writestr("P.npy", npy((1,), b"\0" * 8))
    with pytest.raises(FileError, match="'P' twice"):
        read_npz(tmp_path / "a.npz", "thing")


def test_arrays_come_back_as_they_were(tmp_path):
    arrays = {"a": np.arange(6.0).reshape(2, 3), "b": np.asfortranarray(np.arange(6).reshape(2, 3)), "c": np.array("x")}
    np.savez(tmp_path / "a.npz", **arrays)
    found = read_npz(tmp_path / "a.npz", "thing")
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype
    np.save(tmp_path / "o.npy", np.array([{}]), allow_pickle=True)
    with pytest.raises(FileError, match="Python objects"):
        read_npy(tmp_path / "o.npy", "thing")


def make_hdf5(path, fill):
    with h5py.File(path, "w") as file:
        fill(file)
    return path


def external(file):
    file["link"] = h5py.ExternalLink("other.h5", "/x")


def elsewhere(file):
    file.create_dataset("raw", (4,), "f4", external=[("/etc/hostname", 0, 16)])


def virtual(file):
    layout = h5py.VirtualLayout((4,), "f4")
    layout[:] = h5py.VirtualSource("other.h5", "x", shape=(4,))
    file.create_virtual_dataset("v", layout)


def unfilled(file):
    file.create_dataset("v", (1000, 1000, 1000), "f4", chunks=(1, 100, 100))


@pytest.mark.parametrize(
    ("fill", "words"),
    [
        (external, "leads to another file"),
        (elsewhere, "lie in another file"),
        (virtual, "put together from other files"),
        (unfilled, "0 bytes are stored"),
    ],
)
def test_hdf5_that_leaves_its_file_or_claims_too_much(tmp_path, fill, words):
    with pytest.raises(FileError, match=words):
        checked_hdf5(make_hdf5(tmp_path / "a.h5", fill))


def test_hdf5_whose_groups_lead_in_a_circle_is_read_once(tmp_path):
    def fill(file):
        file.create_group("a")["back"] = file["/"]
        file["soft"] = h5py.SoftLink("/nowhere")
        file["a/images"] = np.zeros((2, 3, 4), np.uint16)

    assert len(open_images(make_hdf5(tmp_path / "a.h5", fill))) == 2


def loops(path):
    while True:
        path = path.parent / path.name


def crashes(path):
    os.kill(os.getpid(), 11)


def swallows(path):
    return len(bytearray(2**40))


@pytest.mark.parametrize(
    ("ask", "words"),
    [(loops, "leads in circles"), (crashes, "signal 11"), (swallows, "more memory than is free")],
)
def test_a_library_that_hangs_crashes_or_swallows_memory(tmp_path, ask, words, monkeypatch):
    monkeypatch.setattr("tomopose.reading.child.MOST_CPU_SECONDS", 1)
    with pytest.raises(FileError, match=words):
        asked_apart(ask, tmp_path / "a.h5", "HDF5 file")


def test_an_answer_of_any_size_comes_back(tmp_path):
    assert len(asked_apart(lambda path: b"x" * 10**7, tmp_path, "thing")) == 10**7


def test_claims_are_held_against_the_file_and_the_memory(monkeypatch):
    memory.require_plausible("a", "it", 100 * 2**20, 1)
    memory.require_plausible("a", "it", 2**30, 2**20)
    with pytest.raises(FileError, match="only 1000 bytes of the file"):
        memory.require_plausible("a", "it", 2**30, 1000)
    monkeypatch.setattr(memory, "available_bytes", lambda: 2**30)
    with pytest.raises(FileError, match=r"a: it would take .* of memory"):
        memory.require_memory("a", "it", 2**30)


def tiff(tmp_path, **options):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.zeros((2, 4, 5), np.uint16), photometric="minisblack", metadata=None, **options)
    return path


@pytest.mark.parametrize("big", [False, True])
def test_tiff_pages_in_a_circle(tmp_path, big):
    path = tiff(tmp_path, bigtiff=big)
    require_sound_tiff(path)
    with tifffile.TiffFile(path) as file:
        first, second = (page.offset for page in file.pages)
        count = len(file.pages[1].tags)
    content = bytearray(path.read_bytes())
    end = second + (8 + 20 * count if big else 2 + 12 * count)
    content[end : end + (8 if big else 4)] = first.to_bytes(8 if big else 4, "little")
    path.write_bytes(content)
    with pytest.raises(FileError, match="lead in a circle"):
        open_images(path)


@pytest.mark.parametrize(
    ("tag", "value", "words"), [(256, 2**31, "side of"), (257, 0, "side of 0"), (256, 60000, "truncated|would take")]
)
def test_tiff_that_claims_more_pixels_than_it_has(tmp_path, tag, value, words):
    path = tiff(tmp_path, compression="zlib")
    with tifffile.TiffFile(path) as file:
        place = file.pages[0].tags[tag].offset
    content = bytearray(path.read_bytes())
    content[place + 2 : place + 12] = (
        (4).to_bytes(2, "little") + (1).to_bytes(4, "little") + value.to_bytes(4, "little")
    )
    path.write_bytes(content)
    with pytest.raises((FileError, InputError), match=f"{words}|one shape"):
        open_images(path)


def test_a_scanner_with_a_key_twice_is_refused(tmp_path):
    (tmp_path / "scanner.json").write_text('{"schema": "tomopose/scanner/1", "d_SD_mm": 1000, "d_SD_mm": 1500}')
    with pytest.raises(FileError, match=r"scanner\.json: the key 'd_SD_mm' occurs twice"):
        read_scanner(tmp_path / "scanner.json")


def test_inline_reading_names_the_file():
    with pytest.raises(FileError, match="frame 3 is no readable radiograph"), reading("frame 3", "radiograph"):
        raise ValueError("x")
