"""Where the work is done: here, in a pool of processes, or on a dask cluster; results come in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    pass


def ordered_map(
    function: Callable[..., Any],
    tasks: Iterable[tuple[Any, ...]],
    *,
    workers: int = 1,
    executor: Any = None,
) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """(task, function(*task)) for each task, in order; few tasks are under way at a time, so that few images are held.

    executor: a concurrent.futures.Executor, or a dask.distributed.Client; it stays open.
    """
    if executor is None and workers <= 1:
        for task in tasks:
            yield task, function(*task)
        return
    with ExitStack() as stack:
        pool: Executor
        if executor is None:
            pool = stack.enter_context(ProcessPoolExecutor(max_workers=workers))
            ahead = 2 * workers + 2
        elif hasattr(executor, "get_executor"):
            pool = stack.enter_context(executor.get_executor(pure=False))
            ahead = 2 * max(sum(executor.nthreads().values()), 1) + 2
        else:
            pool = executor
            ahead = 2 * max(workers, getattr(executor, "_max_workers", 4)) + 2
        waiting: deque[tuple[tuple[Any, ...], Any]] = deque()
        try:
            for task in tasks:
                waiting.append((task, pool.submit(function, *task)))
                if len(waiting) >= ahead:
                    first, future = waiting.popleft()
                    yield first, future.result()
            while waiting:
                first, future = waiting.popleft()
                yield first, future.result()
        finally:
            for _, future in waiting:
                future.cancel()
