"""`tomopose doctor`: what is installed, what is missing, and the line that installs it."""

from __future__ import annotations

import importlib.util
import os
import platform
import shutil
from typing import Any

import typer

from tomopose.cli.common import OK, JsonOption, QuietOption, Say

EPILOG = "Example: tomopose doctor --json"

EXTRAS = {
    "recon": ("itk-rtk",),
    "gpu": ("astra-toolbox",),
    "metrology": ("vtk", "scikit-image", "cmcrameri", "matplotlib"),
    "sim": ("spekpy", "xraydb", "embreex", "trimesh", "manifold3d"),
    "gvxr": ("gvxr",),
    "zeiss": ("olefile",),
    "step": ("cascadio",),
    "dask": ("dask", "distributed"),
    "notebook": ("plotly",),
}
CORE = (
    "numpy",
    "scipy",
    "numba",
    "pydantic",
    "typer",
    "rich",
    "tifffile",
    "imagecodecs",
    "h5py",
    "pydicom",
    "jinja2",
)
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def register(app: typer.Typer) -> None:
    app.command("doctor", epilog=EPILOG)(doctor)


def doctor(as_json: JsonOption = False, quiet: QuietOption = False) -> int:
    """Say which engines and extras are found, their versions, and how to install what is missing."""
    from tomopose.provenance import package_version
    from tomopose.studies.warmup import JOBS, compiled_jobs

    compiled = compiled_jobs()
    extras: dict[str, dict[str, Any]] = {
        extra: {
            "packages": {name: package_version(name) for name in packages},
            "complete": all(package_version(name) != "not installed" for name in packages),
            "install": f'pip install "tomopose[{extra}]"',
        }
        for extra, packages in EXTRAS.items()
    }
    rtk = package_version("itk-rtk") != "not installed"
    cuda = importlib.util.find_spec("astra") is not None and shutil.which("nvidia-smi") is not None
    engines = {
        "cpu": "available",
        "reference": "available",
        "rtk": "available" if rtk else 'pip install "tomopose[recon]"',
        "astra": "available" if cuda else 'needs a CUDA device and pip install "tomopose[gpu]"',
    }
    summary = {
        "tomopose": package_version(),
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        "processors": os.cpu_count(),
        "core": {name: package_version(name) for name in CORE},
        "extras": extras,
        "engines": engines,
        "compiled": {name: name in compiled for name in JOBS},
        "browser": next((b for b in BROWSERS if shutil.which(b)), None),
    }
    lines = [f"tomopose {package_version()}, Python {platform.python_version()}, {os.cpu_count()} processors"]
    for extra, found in extras.items():
        state = "complete" if found["complete"] else f"incomplete; {found['install']}"
        lines.append(f"  [{extra}] {state}: " + ", ".join(f"{k} {v}" for k, v in found["packages"].items()))
    lines += [f"  engine {name}: {state}" for name, state in engines.items()]
    left = [name for name in JOBS if name not in compiled]
    lines.append(
        f"  kernels of {', '.join(left)} are not compiled yet; tomopose warmup does it, or the first command that "
        "needs them"
        if left
        else "  kernels are compiled"
    )
    Say(json=as_json, quiet=quiet).result(summary, lines)
    return OK
