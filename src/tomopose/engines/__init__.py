"""Reconstruction engines behind one protocol: `make_engine`, `available_engines`."""

from __future__ import annotations

from importlib import import_module

from tomopose.engines.protocol import Availability, Engine
from tomopose.errors import EngineMissingError, InputError
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.volume import VoxelGrid

ENGINES = {
    "cpu": ("tomopose.engines.cpu", "CpuEngine"),
    "reference": ("tomopose.engines.reference", "ReferenceEngine"),
    "rtk": ("tomopose.engines.rtk", "RtkEngine"),
    "astra": ("tomopose.engines.astra", "AstraEngine"),
}


def available_engines() -> tuple[Availability, ...]:
    """Every engine, whether it can run here, and why not."""
    return tuple(import_module(module).availability() for module, _ in ENGINES.values())


def make_engine(name: str, matrices: ProjectionMatrices, grid: VoxelGrid, **options: object) -> Engine:
    """The engine of that name for one scan and one grid; "auto" is the GPU where there is one, else the CPU.

    Raises InputError for an unknown name, EngineMissingError where the engine cannot run here.
    """
    if name == "auto":
        name = "astra" if import_module("tomopose.engines.astra").availability().available else "cpu"
    if name not in ENGINES:
        raise InputError(f"engine is {name!r}; auto, {', '.join(ENGINES)} are known")
    module, kind = ENGINES[name]
    home = import_module(module)
    state = home.availability()
    if not state.available:
        raise EngineMissingError(f"engine {name} cannot run here: {state.reason}", install_line=state.install_line)
    engine: Engine = getattr(home, kind)(matrices, grid, **options)
    return engine
