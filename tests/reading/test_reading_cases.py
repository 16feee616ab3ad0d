"""Files that made other libraries raise, hang or fill the memory: each is refused by name, by one line of our own."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import tomopose as tp
from tomopose.errors import FileError, TomoposeError
from tomopose.exports.reading import read_geometry
from tomopose.io.volume_files import read_volume
from tomopose.manipulator.files import read_manipulator
from tomopose.manipulator.twin_file import read_twin
from tomopose.measurement.mesh.mesh_files import read_mesh


@pytest.fixture(scope="module")
def cases(shared_data) -> Path:
    return shared_data / "cases"


def all_images(path):
    images = tp.open_images(path)
    for i in range(len(images)):
        images[i]


def side(path):
    geometry = path.parents[1] / "geometry-astra-rtk-tigre-leap" / "rtk_plain.xml"
    return read_geometry(geometry, side=path, n_u=100, n_v=80)


READ_WITH = {
    "calibrate --scanner": tp.read_scanner,
    "import-geometry": read_geometry,
    "import-geometry rtk.xml --side": side,
    "detect --images": all_images,
    "calibrate --manipulator": read_manipulator,
    "calibrate --manipulator (twin robots)": read_twin,
    "export --matrices": tp.read_matrices,
    "measure, plan scan (mesh)": read_mesh,
}


def test_every_exception_of_another_library_becomes_one_of_ours(cases, tmp_path):
    folder = cases / "foreign-exceptions"
    index = json.loads((folder / "index.json").read_text())
    for name, entry in index.items():
        path, how = folder / name, entry["read_with"]
        if "FOLDER" in how:
            shutil.copy(path, tmp_path / "manifest.json")
            path, read = tmp_path, read_geometry
        elif how.startswith("Python"):
            path, read = json.loads(path.read_text()), tp.run_from_ctsimu
        else:
            read = READ_WITH[how]
        with pytest.raises(TomoposeError) as refused:
            read(path)
        message = str(refused.value)
        assert len(message) > 20, name
        assert "\n" not in message, name
        assert how.startswith("Python") or Path(str(path)).name in message, (name, message)
    assert len(index) == 41


LIMITED = """
import resource, sys
sys.path[:0] = [sys.argv[1]]
import h5py, tifffile
from pathlib import Path
from test_reading_cases import all_images
from tomopose.errors import FileError
from tomopose.io.volume_files import read_volume
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for path in map(Path, sys.argv[2:]):
    try:
        (read_volume if path.suffix == ".h5" else all_images)(path)
    except FileError as error:
        print(error)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


@pytest.mark.slow
def test_small_files_neither_hang_nor_fill_the_memory(cases):
    bombs = sorted(p for p in (cases / "small-bombs").iterdir() if p.suffix in (".h5", ".tif"))
    assert len(bombs) == 8
    command = [sys.executable, "-c", LIMITED, str(Path(__file__).parent), *map(str, bombs)]
    ended = subprocess.run(command, check=False, capture_output=True, text=True, timeout=600)
    *said, grown_kib = ended.stdout.splitlines()
    assert ended.returncode == 0, ended.stderr
    assert len(said) == len(bombs)
    for path, line in zip(bombs, said, strict=True):
        assert path.name in line
    assert int(grown_kib) < 300_000


def test_a_volume_of_another_kind_is_refused(tmp_path):
    (tmp_path / "v.h5").write_bytes(b"no HDF5 at all")
    with pytest.raises(FileError, match=r"v\.h5 is no readable HDF5 file"):
        read_volume(tmp_path / "v.h5")
