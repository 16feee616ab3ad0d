"""What a calibration means for measured lengths: from its covariance through the matrices and the volume to the part.

A wrong calibration moves each point of the reconstruction by a smooth field.  Along every principal direction of the
covariance, of what was estimated and of what no ball shows, the points of all features are moved by that field, the
features fitted and the measurands evaluated again; the changes add up in squares.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from tomopose.calibration.result import Calibration
from tomopose.calibration.uncertainty.propagation import scan_displacement
from tomopose.errors import InputError
from tomopose.manipulator.poses import PoseSequence
from tomopose.measurement.bench import refitted
from tomopose.measurement.features.feature import Feature
from tomopose.measurement.measure import evaluate
from tomopose.measurement.plan import MeasurementPlan
from tomopose.measurement.result import FORMS
from tomopose.measurement.results import MeasurementResults
from tomopose.units import Array

NODES = 3
"""Places a side at which the field is worked out; between them it is quadratic."""
POINTS = 300
"""Points of a feature that are moved."""


def calibration_shares(
    results: MeasurementResults, plan: MeasurementPlan, volume: str, calibration: Calibration, poses: PoseSequence
) -> Mapping[str, float]:
    """Measurand -> standard uncertainty, mm or rad, that the calibration's covariance leaves in one volume's results.

    Form deviations have none: they do not follow the points linearly.  InputError where the volume was not measured.
    """
    if volume not in results.features:
        raise InputError(f"there are no results of a volume {volume!r}; known: {', '.join(results.volumes)}")
    features = results.features[volume]
    points = {n: _some(f) for n, f in features.items()}
    everywhere = np.concatenate(list(points.values()))
    low, high = everywhere.min(axis=0), everywhere.max(axis=0)
    side = np.linspace(-1.0, 1.0, NODES)
    nodes = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3)
    half = np.maximum((high - low) / 2, 1e-6)
    field, C = scan_displacement(calibration, poses, (low + high) / 2 + nodes * half)
    values, vectors = np.linalg.eigh(C)
    directions = vectors * np.sqrt(np.maximum(values, 0.0))
    scale, alignment = results.scale.get(volume, 1.0), results.alignments[volume]

    def measured(shift: Array | None) -> dict[str, float]:
        moved = {}
        for name, x in points.items():
            at = (x - (low + high) / 2) / half
            dx = 0.0 if shift is None else _quadratic(at) @ shift
            moved[name] = refitted(features[name], x + dx)
        return {r.name: r.value for r in evaluate(plan, moved, alignment, scale) if r.kind not in FORMS}

    nominal = measured(None)
    variance = dict.fromkeys(nominal, 0.0)
    for k in np.flatnonzero(values > 0):
        for name, value in measured(field @ directions[:, k]).items():
            variance[name] += (value - nominal[name]) ** 2
    return {name: math.sqrt(v) for name, v in variance.items()}


def _some(feature: Feature) -> Array:
    """Some of the used points, and all that determine the feature by themselves."""
    x = feature.points[feature.used]
    return np.concatenate([feature.points[list(feature.contacts)], x[:: -(-len(x) // POINTS)]])


def _quadratic(x: Array) -> Array:
    """(n, 27) weights of the nodes at places x (n, 3) between -1 and 1: products of Lagrange's parabolas."""
    one = np.stack([0.5 * x * (x - 1), 1 - x**2, 0.5 * x * (x + 1)], axis=-1)
    result: Array = np.einsum("ni,nj,nk->nijk", one[:, 0], one[:, 1], one[:, 2]).reshape(len(x), -1)
    return result
