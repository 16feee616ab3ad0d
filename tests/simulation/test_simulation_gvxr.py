"""gVirtualXray as a second engine: the same scene, the same image, and a plain word where it is missing."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace

import numpy as np
import pytest

from tomopose import PoseSequence, RigidTransform, Scanner
from tomopose.errors import EngineFailedError, EngineMissingError
from tomopose.geometry.frames import Frame
from tomopose.simulation.objects.shapes import Solid, box, sphere
from tomopose.simulation.run import simulate_ball_run, transmission

SMALL = Scanner(d_SD=800.0, d_SR=200.0, p_u=0.4, p_v=0.5, u_0=41.3, v_0=38.7, n_u=81, n_v=77)
T_BALL = np.array([0.25, 0.55, -0.65])


@pytest.fixture
def run():
    mount = RigidTransform.from_angles([0.02, 0.03, 3.1], [0.5, -0.4, 0.3], source=Frame.H, target=Frame.T)
    poses = PoseSequence.from_table([[0, 0, 0]], [[3, -2, 1]])
    solids = (
        Solid(shape=box(5, 4, 1).placed(t=T_BALL), material="Al"),
        Solid(shape=sphere(2.0).placed(t=T_BALL), material="WC-Co"),
    )
    made = simulate_ball_run(SMALL, T_HT=mount, t=T_BALL, poses=poses, ball_diameter=4.0, solids=solids)
    return replace(made, detector=replace(made.detector, cells=4))


def test_both_engines_make_the_same_image(run):
    if importlib.util.find_spec("gvxrPython3") is None:
        pytest.skip("gvxr is not installed (extra: gvxr)")
    pytest.importorskip("manifold3d")
    try:
        theirs = transmission(replace(run, engine="gvxr"), 0)
    except EngineFailedError as error:
        pytest.skip(f"gvxr cannot start here: {error}")
    own = transmission(run, 0)
    assert own.min() < 0.05
    # gVXR samples the middle of each of 16 cells and sees facets: a tenth of a grey step at the rim, none inside.
    assert np.abs(own - theirs).max() < 0.06
    assert np.sqrt(((own - theirs) ** 2).mean()) < 4e-3
    g_v, g_u = np.gradient(own)
    A = np.stack([g_u.ravel(), g_v.ravel()], axis=1)
    shift = np.linalg.lstsq(A, (own - theirs).ravel(), rcond=None)[0]
    assert np.abs(shift).max() < 5e-3


def test_a_missing_engine_says_how_to_get_it(run, monkeypatch):
    pytest.importorskip("manifold3d")
    monkeypatch.setitem(sys.modules, "gvxrPython3", None)
    monkeypatch.setattr("tomopose.simulation.projector.gvxr._started", [])
    with pytest.raises(EngineMissingError, match="gvxr") as caught:
        transmission(replace(run, engine="gvxr"), 0)
    assert "pip install" in caught.value.install_line
