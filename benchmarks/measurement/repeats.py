"""How often the intervals of repeats hold the truth: normal errors, seeded.

    python benchmarks/measurement/repeats.py [--runs 20000]

For 2, 3, 5 and 20 repeats: one further scan within U, the mean within U_mean, and one further scan within U where a
calibrated reference shows a mean error of 0, 1 and 10 standard deviations.
"""

from __future__ import annotations

import argparse
import math

import numpy as np

from tomopose.measurement.budget import repeat_of
from tomopose.measurement.result import MeasurementResult

TRUTH = 12.0


def rows(values, **more):
    return [
        MeasurementResult(
            name="L", kind="distance", value=float(v), u=math.nan, unit="mm", method="", direction="", **more
        )
        for v in values
    ]


def held(n, runs, bias=0.0, **more):
    """(share of further scans within U, share of means within U_mean)."""
    rng = np.random.default_rng([n, round(1000 * bias)])
    scans = TRUTH + 0.002 * (bias + rng.standard_normal((runs, n + 1)))
    found = [(s[0], repeat_of("group", rows(s[1:], **more))) for s in scans]
    return (
        float(np.mean([abs(x - TRUTH) <= r.U for x, r in found])),
        float(np.mean([abs(r.mean - TRUTH) <= r.U_mean for _, r in found])),
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=20000)
    runs = parser.parse_args().runs
    print("repeats  further scan  mean  with a calibrated reference and a bias of 0, 1, 10 s")
    for n in (2, 3, 5, 20):
        one, mean = held(n, runs)
        biased = [held(n, runs, b, reference=TRUTH)[0] for b in (0.0, 1.0, 10.0)]
        print(f"{n:7d}  {100 * one:12.1f}  {100 * mean:4.1f}  " + "  ".join(f"{100 * b:.1f}" for b in biased))


if __name__ == "__main__":
    main()
