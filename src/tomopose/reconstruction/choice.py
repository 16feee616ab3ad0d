"""Which algorithm a scan allows, which one is the default, and why, in words."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from tomopose.engines.protocol import Limits
from tomopose.errors import EngineError, TrajectoryError
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.reconstruction.fdk.path import SourcePath, height_obstacle, holes_obstacle, source_path
from tomopose.reconstruction.fdk.redundancy import Fan, Redundancy, fan_of, lines_missing, reach_of
from tomopose.reconstruction.line_integrals import LineIntegrals
from tomopose.reconstruction.settings import FDK, SART, Algorithm, name_of
from tomopose.volume import VoxelGrid

FEWEST_FOR_FDK = 16
"""Views a turn below which FDK is refused, in proportion on a short scan.

N views integrate the first N angular harmonics; a part of radius r at the distance rho from the axis has about
2 pi rho / (4 r) of them on either side of 0, which makes 16 for a part of a fifth of the field.  On such parts (64^3
voxels, circle and 8 degrees of tilt) 16 views leave 0.25 to 0.28 of the signal unexplained and densities within 4 %, 12
views 0.42 to 0.46 and 8 %, 8 views 0.94 and 18 %; SART leaves 0.10.
"""
ENOUGH_FOR_FDK = 36
"""Views from which FDK alone is the default on a smooth full turn: its densities are then right to 0.3 %, those of
FDK with a sweep of SART to 2 %, centres of balls to 0.009 and 0.005 voxel.  Chosen from scans of 24, 36, 48, 72 and
120 views (same object); not tuned finer."""
PROBED, STRIP, BLOCK = 16, 3, 8
"""Views whose rims are looked at; columns and rows over which line integrals are averaged there."""
AIR = 0.05
"""A rim counts as air up to this share of the largest line integrals: twice what an open beam that is off by 2 % in a
radiograph of 10 % transmission gives."""
CUT_ROWS = 0.1
"""Share of the grid's rows that an object may have beyond the rim before the panel counts as too narrow for it."""


@dataclass(frozen=True, kw_only=True)
class Situation:
    """What decides on the algorithm.

    n: views; path, fan: None where the views do not determine a path; needed: fan angle that the grid asks for, rad;
    cut_low, cut_high: share of the grid's rows in which the object reaches beyond the panel, on the side of negative
    and positive fan angles.
    """

    n: int
    path: SourcePath | None
    fan: Fan | None
    needed: float
    cut_low: float
    cut_high: float

    @property
    def cut_short(self) -> float:
        """Share of rows cut on the side of which the panel sees less."""
        assert self.fan is not None
        return self.cut_low if self.fan.low < self.fan.high else self.cut_high

    @property
    def cut_long(self) -> float:
        """Share of rows cut on the side of which the panel sees more."""
        assert self.fan is not None
        return self.cut_high if self.fan.low < self.fan.high else self.cut_low

    @property
    def displaced(self) -> bool:
        """Whether the object is seen whole on one side of the axis only."""
        return self.fan is not None and self.cut_short > CUT_ROWS >= self.cut_long


@dataclass(frozen=True, kw_only=True)
class Choice:
    """algorithm: what is done; words: why, one sentence; redundancy: its weights, where FDK takes part."""

    algorithm: Algorithm
    words: str
    redundancy: Redundancy | None


def situation_of(scan: LineIntegrals, grid: VoxelGrid) -> Situation:
    """Reads the path off the matrices and looks at the rims of a few views."""
    path = source_path(scan.matrices)
    if path is None:
        return Situation(n=len(scan), path=None, fan=None, needed=0.0, cut_low=0.0, cut_high=0.0)
    fan = fan_of(scan.matrices, path)
    first, last = cut_rows(scan, grid)
    low, high = (first, last) if fan.first_low else (last, first)
    return Situation(
        n=len(scan),
        path=path,
        fan=fan,
        needed=reach_of(path, fan, grid.corners),
        cut_low=low,
        cut_high=high,
    )


def cut_rows(scan: LineIntegrals, grid: VoxelGrid) -> tuple[float, float]:
    """Largest share of the grid's rows, of any view looked at, in which there is matter in the first columns, and in
    the last."""
    strips, largest = [], 0.0
    for j in np.unique(np.linspace(0, len(scan) - 1, min(PROBED, len(scan))).round().astype(int)):
        v = scan.matrices.project(grid.corners)[j, :, 1]
        low, high = np.clip([np.floor(v.min()), np.ceil(v.max()) + 1], 0, scan.matrices.n_v).astype(int)
        p = scan[int(j)][low:high] if high > low else scan[int(j)]
        largest = max(largest, float(np.percentile(p, 99.5)))
        edges = np.arange(0, len(p), BLOCK)
        rows = np.diff(np.append(edges, len(p)))[:, None]
        ends = np.stack([p[:, :STRIP].mean(axis=1), p[:, -STRIP:].mean(axis=1)], axis=1)
        strips.append(np.add.reduceat(ends, edges, axis=0) / rows)
    shares = np.stack([(strip > AIR * largest).mean(axis=0) for strip in strips])
    return float(shares[:, 0].max()), float(shares[:, 1].max())


def fdk_obstacle(s: Situation) -> str:
    """Why FDK is not defined here, in words; empty where it is."""
    if s.path is None or s.fan is None:
        return f"{s.n} views do not determine a path of the source"
    on_way = _few_or_rough(s.n, s.path)
    if on_way:
        return on_way
    if s.fan.overlap <= 0:
        return "the panel does not see the axis of the path in every view"
    if s.cut_long > CUT_ROWS:
        return (
            f"the object reaches beyond the panel on {'both sides' if s.cut_short > CUT_ROWS else 'its longer side'} "
            f"in {100 * s.cut_long:.0f} % of the grid's rows"
        )
    if s.path.full_turn:
        return ""
    return short_scan_obstacle(s, s.path)


def _few_or_rough(n: int, path: SourcePath) -> str:
    if n < FEWEST_FOR_FDK * path.coverage / (2 * math.pi):
        return f"{n} views are too few: below {FEWEST_FOR_FDK} a turn its sum over the views is no integral any more"
    return height_obstacle(path)


def path_obstacle(matrices: ProjectionMatrices) -> str:
    """Why FDK cannot follow the source along these views, whatever the panel sees, in words; empty where it can."""
    path = source_path(matrices)
    if path is None:
        return f"{len(matrices)} views do not determine a path of the source"
    return _few_or_rough(len(matrices), path) or holes_obstacle(path)


def short_scan_obstacle(s: Situation, path: SourcePath) -> str:
    """Why FDK is not defined on a path with holes, in words; empty where it is."""
    covered = math.degrees(path.coverage)
    holes = holes_obstacle(path)
    if holes:
        return holes
    if lines_missing(path, s.needed):
        return (
            f"the source covers {covered:.0f} degrees, and every line through the grid is measured from "
            f"{180 + 2 * math.degrees(s.needed):.0f} on"
        )
    if s.displaced:
        return f"the panel sees one side of the object only, and the source covers {covered:.0f} of 360 degrees"
    return ""


def choose(asked: Algorithm | None, s: Situation, scan: LineIntegrals, limits: Limits, engine: str) -> Choice:
    """The algorithm asked for, or the default for this scan.

    Raises TrajectoryError where FDK, alone or as a start, is asked for and not defined here, EngineError where the
    engine has none.
    """
    obstacle, redundancy = fdk_obstacle(s), None
    if not obstacle and s.path is not None and s.fan is not None:
        redundancy = Redundancy(matrices=scan.matrices, path=s.path, fan=s.fan, displaced=s.displaced)
    able = "inverse-square" in limits.weights
    if asked is None:
        return default(s, obstacle, redundancy, engine if not able else "")
    if isinstance(asked, SART) and asked.start == "auto":
        lacking = obstacle if able else f"engine {engine} has no distance-weighted back-projection"
        start = None if lacking else FDK()
        words = (
            f"sart: from zero, because FDK is not defined here: {lacking}" if lacking else "fdk+sart: FDK is the start"
        )
        return Choice(algorithm=replace(asked, start=start), words=words, redundancy=redundancy)
    part = filtered_part(asked)
    if part is None:
        return Choice(algorithm=asked, words=f"{name_of(asked)}: as asked for", redundancy=None)
    if not able:
        raise EngineError(f"engine {engine} has no distance-weighted back-projection; FDK needs engine cpu")
    if obstacle and (not part.preview or s.path is None):
        role = "" if isinstance(asked, FDK) else " as a start"
        look = (
            ' For a quick look at what it gives all the same, use algorithm="fdk-preview".'
            if s.path is not None
            else ""
        )
        raise TrajectoryError(f'FDK{role} is not defined here: {obstacle}. Use algorithm="sart".{look}')
    words = f"{name_of(asked)}: as asked for" + (f", although {obstacle}" if obstacle else "")
    return Choice(algorithm=asked, words=words, redundancy=redundancy)


def filtered_part(algorithm: Algorithm) -> FDK | None:
    """The FDK that an algorithm is, or begins with."""
    if isinstance(algorithm, SART):
        return algorithm.start if isinstance(algorithm.start, FDK) else None
    return algorithm if isinstance(algorithm, FDK) else None


def default(s: Situation, obstacle: str, redundancy: Redundancy | None, lacking: str) -> Choice:
    """What is done where nobody asks for an algorithm; lacking: the engine, where it has no FDK."""
    if lacking:
        return Choice(algorithm=SART(), words=f"sart: engine {lacking} has no FDK", redundancy=None)
    if obstacle:
        return Choice(algorithm=SART(), words=f"sart: FDK is not defined here, because {obstacle}", redundancy=None)
    assert s.path is not None
    if not s.path.full_turn:
        why = f"the source covers {math.degrees(s.path.coverage):.0f} of 360 degrees"
    elif s.n < ENOUGH_FOR_FDK:
        why = f"{s.n} views are fewer than the {ENOUGH_FOR_FDK} from which FDK alone is the better one"
    else:
        side = ", which a laterally displaced panel sees one side at a time" if s.displaced else ""
        words = f"fdk: the source makes a smooth full turn of {s.n} views{side}"
        return Choice(algorithm=FDK(), words=words, redundancy=redundancy)
    return Choice(algorithm=SART(start=FDK()), words=f"fdk+sart: {why}", redundancy=redundancy)
