"""State of an unfinished reconstruction, so that a killed one goes on and ends with the same numbers."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tomopose.errors import InputError
from tomopose.files import plain, read_json, write_json
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.reconstruction.field import Field
from tomopose.volume import VoxelGrid

NAME = "reconstruction-checkpoint"


def fingerprint(matrices: ProjectionMatrices, grid: VoxelGrid, settings: Mapping[str, Any]) -> str:
    """SHA-256 over everything that the result depends on but the images' content."""
    digest = hashlib.sha256(np.ascontiguousarray(matrices.P).tobytes())
    rest = {
        "detector": [matrices.n_u, matrices.n_v, matrices.p_u, matrices.p_v],
        "grid": [list(grid.shape), grid.spacing.tolist(), grid.centre.tolist()],
        "settings": dict(settings),
    }
    digest.update(json.dumps(plain(rest), sort_keys=True).encode())
    return digest.hexdigest()


class Checkpoint:
    """Saves the field into `folder` after an update, at most every `seconds`, and says where to go on.

    Two generations alternate: state.json names the whole one, and is replaced only once the other is whole.
    """

    def __init__(
        self, folder: Path, identity: str, *, seconds: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._folder, self._identity, self._seconds, self._clock = folder, identity, seconds, clock
        self._last = clock()
        self._generation = 0

    def resume(self, field: Field) -> int:
        """Load the newest state into the field and return the number of updates that are done; 0 for a new start.

        InputError where the folder holds the state of another reconstruction.
        """
        state = self._folder / "state.json"
        if not state.exists():
            return 0
        document = read_json(state, NAME)
        if document.get("fingerprint") != self._identity:
            raise InputError(
                f"{self._folder} holds the checkpoint of another reconstruction (matrices, grid or settings differ); "
                "give another folder or remove it"
            )
        self._generation = int(document["generation"])
        field.load(self._folder / f"saved-{self._generation}")
        return int(document["updates_done"])

    def after(self, field: Field, done: int) -> None:
        """Called after each update."""
        if self._clock() - self._last < self._seconds:
            return
        generation = 1 - self._generation
        field.save(self._folder / f"saved-{generation}")
        write_json(
            self._folder / "state.json",
            NAME,
            {"fingerprint": self._identity, "generation": generation, "updates_done": done},
        )
        shutil.rmtree(self._folder / f"saved-{self._generation}", ignore_errors=True)
        self._generation = generation
        self._last = self._clock()

    def remove(self) -> None:
        """The reconstruction is done: nothing is left to resume."""
        for generation in (0, 1):
            shutil.rmtree(self._folder / f"saved-{generation}", ignore_errors=True)
        (self._folder / "state.json").unlink(missing_ok=True)
