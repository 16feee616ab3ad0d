"""How often does `monitor` raise a false alarm, and how soon a right one?  python benchmarks/reality/monitor.py

Histories are drawn here: normal values about a constant, with the standard uncertainty that they state or a smaller
one.  After every new run the whole history is looked at, as a user does.  Printed: the share of unchanged histories
with a false alarm within the given number of runs, and the number of runs after a step until an alarm names it.
"""

from __future__ import annotations

import argparse

import numpy as np

from tomopose.calibration.records.monitor import monitor

NUMBERS = ("t_HT_x", "t_HT_y", "t_HT_z", "t_x")
FIRST = 4


def history(rng: np.random.Generator, n: int, *, stated: float, step: float = 0.0, at: int = 0) -> list[dict]:
    """n runs that scatter by 1 and state `stated`; from run `at` on t_HT_x is larger by `step`."""
    x = rng.normal(size=(n, len(NUMBERS)))
    x[at:, 0] += step
    residual = 1.0 + 0.05 * rng.normal(size=n)
    return [
        {
            "label": f"r{k}",
            "time_utc": "",
            "parameters": {
                name: {"value": float(v), "u": stated, "unit": "mm"} for name, v in zip(NUMBERS, x[k], strict=True)
            },
            "d_rms_px": float(residual[k]),
        }
        for k in range(n)
    ]


def false_alarms(n: int, histories: int, stated: float, seed: int) -> tuple[int, int]:
    """(histories with a false alarm within n runs, looks that raised one) of unchanged histories."""
    touched = looks = 0
    for k in range(histories):
        runs = history(np.random.default_rng([seed, k]), n, stated=stated)
        raised = [bool(monitor(runs[:m]).alarms) for m in range(FIRST, n + 1)]
        touched += any(raised)
        looks += sum(raised)
    return touched, looks


def delays(n: int, histories: int, step: float, seed: int) -> list[int | None]:
    """Runs from the step on until an alarm of t_HT_x; None where none came within n runs."""
    found: list[int | None] = []
    at = n // 2
    for k in range(histories):
        runs = history(np.random.default_rng([seed, k]), n, stated=1.0, step=step, at=at)
        raised = (
            m - at for m in range(at + 1, n + 1) if any(a.parameter == "t_HT_x" for a in monitor(runs[:m]).alarms)
        )
        found.append(next(raised, None))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--histories", type=int, default=40)
    parser.add_argument("--runs", type=int, default=24)
    parser.add_argument("--seed", type=int, default=1)
    o = parser.parse_args()
    looks = o.runs - FIRST + 1
    print(f"{o.histories} histories of {o.runs} runs, {len(NUMBERS) + 1} numbers, seed {o.seed}")
    for stated in (1.0, 0.5):
        touched, raised = false_alarms(o.runs, o.histories, stated, o.seed)
        print(
            f"unchanged, stated over true scatter {stated:g}: {touched} of {o.histories} histories with a false alarm, "
            f"{raised} of {o.histories * looks} looks",
            flush=True,
        )
    for step in (2.0, 3.0, 5.0, 10.0):
        found = delays(o.runs, o.histories // 2, step, o.seed)
        seen = [d for d in found if d is not None]
        middle = f"{np.median(seen):g}" if seen else "-"
        print(
            f"step of {step:g} sigma: named in {len(seen)} of {len(found)} histories, median after {middle} runs",
            flush=True,
        )


if __name__ == "__main__":
    main()
