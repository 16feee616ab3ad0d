"""What an unfinished refinement keeps after each level: a killed one continues and ends with the same numbers."""

from __future__ import annotations

import shutil
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tomopose.files import atomic_file
from tomopose.kept import Key, StartsAnewWarning, digest_of_images, goes_on, key_of, write_key
from tomopose.reconstruction.line_integrals import LineIntegrals
from tomopose.refinement.joint_fit.balls import Balls
from tomopose.refinement.joint_fit.fit import State
from tomopose.refinement.prior import Prior
from tomopose.refinement.settings import RefineSettings
from tomopose.volume import VoxelGrid

NAME = "refinement-checkpoint"


@dataclass(frozen=True, kw_only=True)
class Reached:
    """levels: done; state: after the last of them; prior: with the sizes by the evidence; faces: of the grid that the
    object crosses."""

    levels: int
    state: State
    prior: Prior
    faces: tuple[str, ...]


def checkpoint_of(
    folder: str | Path | None,
    scan: LineIntegrals,
    grid: VoxelGrid,
    prior: Prior,
    settings: RefineSettings,
    levels: tuple[int, ...],
    balls: Balls | None = None,
) -> Checkpoint | None:
    """The checkpoint in a folder, with the key of everything that the numbers depend on; None without a folder."""
    if folder is None:
        return None
    m = scan.matrices
    key = key_of(
        NAME,
        images=digest_of_images(scan.raw(j) for j in range(len(scan))),
        correction=scan.correction,
        matrices=m.P,
        detector={"n_u": m.n_u, "n_v": m.n_v, "p_u": m.p_u, "p_v": m.p_v},
        grid={"shape": grid.shape, "spacing": grid.spacing, "centre": grid.centre},
        prior=prior.covariance,
        settings=replace(settings, threads=None, memory_gib=None, client=None),
        levels=levels,
        balls=None if balls is None else {"z": balls.z, "root": balls.root, "radius_mm": balls.radius_mm},
    )
    return Checkpoint(Path(folder), key)


class Checkpoint:
    """Keeps what was reached in `folder`: key.json of everything that the numbers depend on, and reached.npz."""

    def __init__(self, folder: Path, key: Key) -> None:
        self._folder, self._key = folder, key

    def resume(self, prior: Prior) -> Reached | None:
        """What was reached with the same key, None for a new start; `prior` as stated.

        StartsAnewWarning says where the folder holds the state of another refinement, or a damaged one.
        """
        what, file = f"the checkpoint in {self._folder}", self._folder / "reached.npz"
        if goes_on(self._folder / "key.json", self._key, what=what) and file.exists():
            try:
                return self._read(file, prior)
            except (OSError, KeyError, ValueError) as error:
                warnings.warn(f"{what} is damaged ({error}); the work starts anew", StartsAnewWarning, stacklevel=2)
        self.remove()
        self._folder.mkdir(parents=True, exist_ok=True)
        write_key(self._folder / "key.json", self._key)
        return None

    def _read(self, file: Path, prior: Prior) -> Reached:
        with np.load(file, allow_pickle=False) as kept:
            state = State(
                volume=kept["volume"],
                q=kept["q"],
                offset=kept["offset"],
                chi=float(kept["chi"]),
                steps=int(kept["steps"]),
                settled=bool(kept["settled"]),
                information=kept["information"],
            )
            return Reached(
                levels=int(kept["levels"]),
                state=state,
                prior=replace(prior, sizes=kept["sizes"], widths=kept["widths"]),
                faces=tuple(str(face) for face in kept["faces"]),
            )

    def keep(self, reached: Reached) -> None:
        """Replaces what was kept before, whole or not at all."""
        s = reached.state
        with atomic_file(self._folder / "reached.npz") as path, path.open("wb") as file:
            np.savez(
                file,
                volume=s.volume,
                q=s.q,
                offset=s.offset,
                chi=s.chi,
                steps=s.steps,
                settled=s.settled,
                information=np.zeros(0) if s.information is None else s.information,
                levels=reached.levels,
                sizes=reached.prior.sizes,
                widths=reached.prior.widths,
                faces=np.array(reached.faces, dtype="U2"),
            )

    def remove(self) -> None:
        """The refinement is done, or another one begins: nothing is left to resume."""
        (self._folder / "reached.npz").unlink(missing_ok=True)
        (self._folder / "key.json").unlink(missing_ok=True)
        if self._folder.is_dir() and not any(self._folder.iterdir()):
            shutil.rmtree(self._folder)
