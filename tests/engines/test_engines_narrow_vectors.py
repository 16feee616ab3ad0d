"""Processors without AVX-512 take vectors of 8 lanes; here they are made to report so."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

PROGRAM = """
import sys
import llvmlite.binding
llvmlite.binding.get_host_cpu_features = llvmlite.binding.targets.FeatureMap  # no feature at all
sys.path.insert(0, sys.argv[1])
import numpy as np
from test_engines_agree import GRID, views
from tomopose.engines import make_engine, vector
assert vector.W == 8
matrices, rng = views(), np.random.default_rng(0)
vectors, plain = (make_engine("cpu", matrices, GRID, kernels=k) for k in ("vector", "plain"))
x, y = rng.random(GRID.shape), rng.random((5, matrices.n_v, matrices.n_u))
every = [0, 1, 2, 3, 4]
a, b = (engine.forward(engine.put(x), every) for engine in (vectors, plain))
assert np.abs(a - b).max() < 2e-5 * b.max()
states = [engine.empty() for engine in (vectors, plain)]
for engine, state in zip((vectors, plain), states):
    engine.back(y, every, into=state, weight="mean")
assert np.abs(states[0] - states[1]).max() < 2e-5
assert states[0].max() > 0.1
"""


@pytest.mark.slow
def test_eight_lanes_give_the_same(tmp_path):
    # A cache of its own: numba files compiled code by processor, and this one is lied to about it.
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, os.path.dirname(__file__)],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
