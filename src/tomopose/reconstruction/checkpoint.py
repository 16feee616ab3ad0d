"""State of an unfinished reconstruction, so that a killed one continues and ends with the same numbers."""

from __future__ import annotations

import shutil
import time
import warnings
from collections.abc import Callable
from pathlib import Path

from tomopose.errors import FileError
from tomopose.files import read_json, write_json
from tomopose.kept import Key, StartsAnewWarning, goes_on, same_key, write_key
from tomopose.reconstruction.field import Field

NAME = "reconstruction-checkpoint"


class Checkpoint:
    """Saves the field into `folder` after an update, at most every `seconds`, and says where to continue.

    key.json holds the key of what the numbers depend on: images, matrices, grid, settings, version.  Two generations
    alternate: state.json names the whole one, and is replaced only once the other is whole.
    """

    def __init__(self, folder: Path, key: Key, *, seconds: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._folder, self._key, self._seconds, self._clock = folder, key, seconds, clock
        self._last = clock()
        self._generation = 0

    def resume(self, field: Field) -> int:
        """Load the newest state into the field and return the number of updates that are done; 0 for a new start.

        StartsAnewWarning says where the folder holds the state of another reconstruction, or a damaged one.
        """
        what = f"the checkpoint in {self._folder}"
        state = self._folder / "state.json"
        if not state.exists():
            return self._anew()
        if not (self._folder / "key.json").exists():
            same_key(None, self._key, what=what)
            return self._anew()
        if not goes_on(self._folder / "key.json", self._key, what=what):
            return self._anew()
        try:
            document = read_json(state, NAME)
            self._generation = int(document["generation"])
            field.load(self._folder / f"saved-{self._generation}")
            return int(document["updates_done"])
        except (FileError, KeyError, TypeError, ValueError) as error:
            warnings.warn(f"{what} is damaged ({error}); the work starts anew", StartsAnewWarning, stacklevel=2)
            return self._anew()

    def _anew(self) -> int:
        """Nothing of another reconstruction stays beside the new key."""
        self.remove()
        write_key(self._folder / "key.json", self._key)
        self._generation = 0
        return 0

    def after(self, field: Field, done: int) -> None:
        """Called after each update."""
        if self._clock() - self._last < self._seconds:
            return
        generation = 1 - self._generation
        field.save(self._folder / f"saved-{generation}")
        write_json(self._folder / "state.json", NAME, {"generation": generation, "updates_done": done})
        shutil.rmtree(self._folder / f"saved-{self._generation}", ignore_errors=True)
        self._generation = generation
        self._last = self._clock()

    def remove(self) -> None:
        """The reconstruction is done: nothing is left to resume.

        state.json goes first: killed in between, what is left names no state that is gone already.
        """
        (self._folder / "state.json").unlink(missing_ok=True)
        for generation in (0, 1):
            shutil.rmtree(self._folder / f"saved-{generation}", ignore_errors=True)
        (self._folder / "key.json").unlink(missing_ok=True)
