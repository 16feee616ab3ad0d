"""The studies by name, and how one is run."""

from __future__ import annotations

import contextlib
import importlib
import time
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from numba.core.event import install_timer

from tomopose.atomic import only_writer
from tomopose.errors import InputError
from tomopose.provenance import provenance
from tomopose.studies.parts.result import DEFAULT_SEED, Progress, Scale, StudyResult, require_scale
from tomopose.studies.parts.steps import Steps

PAPER: Mapping[str, str] = MappingProxyType(
    {
        "table1": "Table 1",
        "table2": "Table 2",
        "figure8": "Fig. 8",
        "figure9": "Fig. 9",
        "tuy": "Sec. 6.3",
        "section6": "Figs. 11 to 16",
        "multi_sphere": "Sec. 6.3, ref. [8]",
        "cylinder": "Fig. 12, in principle",
        "improvements": "Sec. 7",
    }
)
"""Study -> what of the paper it repeats, in the order in which one reads them; each is a module of this folder."""


def run_study(
    name: str,
    *,
    scale: Scale = "small",
    seed: int = DEFAULT_SEED,
    folder: str | Path | None = None,
    progress: Progress | None = None,
) -> StudyResult:
    """Run a study: its numbers beside the paper's.

    Parameters
    ----------
    name:     a key of PAPER.
    scale:    "small": minutes at most, same physics, fewer poses; "paper": the paper's full plan.
    seed:     of all random numbers; the same seed gives the same numbers.
    folder:   where steps are kept, so that an interrupted run continues; None keeps none.
    progress: called with (done, total).

    Raises InputError for an unknown name or scale.
    """
    if name not in PAPER:
        raise InputError(f"unknown study {name!r}; known are {', '.join(PAPER)}")
    require_scale(scale)
    module: Any = importlib.import_module(f"tomopose.studies.{name}")
    steps = Steps(
        folder=None if folder is None else Path(folder) / "steps",
        key={"study": name, "scale": scale, "seed": seed},
    )
    begin, worked = time.perf_counter(), time.process_time()
    compiled: list[float] = []
    with (
        install_timer("numba:compile", compiled.append),
        contextlib.nullcontext() if folder is None else only_writer(Path(folder)),
    ):
        rows, checks, figures, notes = module.run(scale, seed, steps, progress or (lambda done, total: None))
    return StudyResult(
        name=name,
        title=module.TITLE,
        paper=PAPER[name],
        question=module.QUESTION,
        scale=scale,
        seed=seed,
        rows=tuple(rows),
        checks=tuple(checks),
        figures=tuple(figures),
        notes=tuple(notes),
        seconds=time.perf_counter() - begin,
        processor_seconds=time.process_time() - worked,
        compile_seconds=sum(compiled),
        provenance=provenance(arguments={"study": name, "scale": scale}, seed=seed),
    )
