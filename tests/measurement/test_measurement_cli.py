"""`tomopose measure` and its page, on the blurred block."""

from __future__ import annotations

import json

import pytest
import typer
from test_measurement_comparison import box, write_stl
from test_measurement_plan import CENTRE, HALF, PLAN, block

from tomopose.cli import measure as verb
from tomopose.errors import FileError, InputError
from tomopose.io.volume_files import write_volume
from tomopose.measurement.meshes import Mesh


def run(*words):
    app = typer.Typer()
    verb.register(app)
    return typer.main.get_command(app).main(args=[str(w) for w in words], standalone_mode=False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("measure")
    (folder / "plan.toml").write_text(PLAN, encoding="utf-8")
    write_volume(block(0.03, 1), folder / "scan.h5")
    mesh = box(HALF, 10)
    write_stl(folder / "part.stl", Mesh(points=mesh.points + CENTRE, faces=mesh.faces))
    return folder


def test_the_whole_verb(folder, capsys):
    out = folder / "out"
    code = run(folder / "plan.toml", "--volume", f"one={folder / 'scan.h5'}", "--volume", f"two={folder / 'scan.h5'}",
               "--reference", folder / "part.stl", "--out", out, "--json")
    assert code == 0
    said = json.loads(capsys.readouterr().out)
    assert said["volumes"] == ["one", "two"]
    assert said["results"] == 8
    page = (out / "report.html").read_text(encoding="utf-8")
    for words in ("Nominal-actual comparison: one", "Deviations in colour", "Distances", "Repeats", "plan.toml"):
        assert words in page
    document = json.loads((out / "measurement.json").read_text(encoding="utf-8"))
    assert set(document["provenance"]["inputs"]) == {"plan.toml", "scan.h5", "part.stl"}
    assert (out / "two" / "comparison.glb").exists()
    with pytest.raises(FileError, match="exists"):
        run(folder / "plan.toml", "--volume", folder / "scan.h5", "--out", out)


def test_two_volumes_of_one_name(folder):
    with pytest.raises(InputError, match="two volumes"):
        run(folder / "plan.toml", "--volume", folder / "scan.h5", "--volume", folder / "scan.h5", "--out",
            folder / "other")


def test_a_missing_volume(folder):
    with pytest.raises(FileError, match="does not exist"):
        run(folder / "plan.toml", "--volume", folder / "none.h5", "--out", folder / "third")
