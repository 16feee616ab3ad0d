"""What installs where: the wheel's metadata, the extras' markers, the conda recipe and the container file."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.requirements import Requirement
from typer.main import get_command

from tomopose.cli.main import app

ROOT = Path(__file__).resolve().parents[1]
MACHINES = {
    "Windows": {"sys_platform": "win32", "platform_machine": "AMD64"},
    "Windows on arm": {"sys_platform": "win32", "platform_machine": "ARM64"},
    "Apple silicon": {"sys_platform": "darwin", "platform_machine": "arm64"},
    "Intel Mac": {"sys_platform": "darwin", "platform_machine": "x86_64"},
    "Linux": {"sys_platform": "linux", "platform_machine": "x86_64"},
    "Linux on arm": {"sys_platform": "linux", "platform_machine": "aarch64"},
}


@pytest.fixture(scope="module")
def pyproject() -> dict[str, Any]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))


def installed_on(pyproject: dict[str, Any], extra: str, machine: str) -> set[str]:
    """The packages of an extra that a machine gets."""
    wanted = [Requirement(text) for text in pyproject["project"]["optional-dependencies"][extra]]
    return {r.name for r in wanted if r.marker is None or r.marker.evaluate(MACHINES[machine])}


@pytest.mark.parametrize("machine", ["Windows", "Apple silicon", "Intel Mac", "Linux", "Linux on arm"])
def test_recon_installs_rtk_wherever_it_has_wheels(pyproject, machine):
    assert installed_on(pyproject, "recon", machine) == {"itk-rtk"}


def test_extras_ask_no_machine_for_a_package_without_a_wheel_for_it(pyproject):
    assert not installed_on(pyproject, "recon", "Windows on arm")
    for machine in ("Apple silicon", "Intel Mac", "Linux on arm", "Windows on arm"):
        assert not installed_on(pyproject, "gpu", machine) | installed_on(pyproject, "gvxr", machine)
    assert "embreex" not in installed_on(pyproject, "sim", "Linux on arm")
    assert "embreex" in installed_on(pyproject, "sim", "Apple silicon")


def test_all_names_every_extra_for_users_but_those_that_need_a_graphics_card_or_its_drivers(pyproject):
    extras = pyproject["project"]["optional-dependencies"]
    (everything,) = (Requirement(text) for text in extras["all"])
    ours = {name for name in extras if name not in ("all", "docs", "test", "dev") and extras[name]}
    assert ours - everything.extras == {"gpu", "gvxr"}


def test_the_readme_of_a_package_index_has_no_link_into_the_repository(pyproject):
    hook = pyproject["tool"]["hatch"]["metadata"]["hooks"]["fancy-pypi-readme"]
    text = "".join((ROOT / part["path"]).read_text("utf-8") for part in hook["fragments"])
    assert re.search(r"\]\((?!https?://|#)", text)  # there is something to replace
    for change in hook["substitutions"]:
        text = re.sub(change["pattern"], change["replacement"], text)
    assert not re.findall(r"\]\((?!https?://|#)[^)]*\)", text)
    assert "docs/tutorial/index.md" in text


def test_the_wheel_holds_the_package_with_its_marker_of_types(pyproject):
    wheel = pyproject["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert wheel == {"packages": ["src/tomopose"]}
    assert (ROOT / "src/tomopose/py.typed").is_file()
    assert "tomopose/py.typed" in (ROOT / ".ci/distributions").read_text("utf-8")


def test_classifiers_name_the_versions_of_python_that_dependencies_are_resolved_for(pyproject):
    named = re.findall(r"Python :: (3\.\d+)", "\n".join(pyproject["project"]["classifiers"]))
    (tried,) = re.findall(r"for version in ([\d. ]+);", (ROOT / ".ci/run").read_text("utf-8"))
    assert named == tried.split() == ["3.11", "3.12", "3.13", "3.14"]


def test_the_conda_recipe_asks_for_the_same_packages(pyproject):
    recipe = yaml.safe_load((ROOT / "recipe/recipe.yaml").read_text("utf-8"))
    runs = {text.replace(" ", "") for text in recipe["requirements"]["run"] if not text.startswith("python ")}
    assert runs == set(pyproject["project"]["dependencies"])
    built = {text.replace(" ", "") for text in recipe["requirements"]["host"]}
    assert set(pyproject["build-system"]["requires"]) <= built
    assert recipe["context"]["version"] == pyproject["project"]["version"]
    (script,) = pyproject["project"]["scripts"].items()
    assert recipe["build"]["python"]["entry_points"] == [" = ".join(script)]


def test_the_container_copies_files_that_exist_and_runs_verbs_that_exist():
    lines = (ROOT / "Containerfile").read_text("utf-8").splitlines()
    for line in lines:
        if line.startswith("COPY"):
            assert all((ROOT / name).exists() for name in line.split()[1:-1])
    verbs = set(get_command(app).commands)  # type: ignore[attr-defined]
    assert 'ENTRYPOINT ["tomopose"]' in lines
    (command,) = (re.findall(r'"([^"]*)"', line) for line in lines if line.startswith("CMD"))
    assert command[0] in verbs
    assert "RUN tomopose warmup" in lines
    assert "warmup" in verbs
