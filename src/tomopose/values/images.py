"""Images by number, however they are kept."""

from __future__ import annotations

from typing import Protocol

from numpy.typing import ArrayLike


class Images(Protocol):
    """n images [v, u]: a list of arrays, an array (n, n_v, n_u), or an `ImageSequence`, which reads when asked."""

    def __len__(self) -> int: ...

    def __getitem__(self, i: int, /) -> ArrayLike: ...
