"""Bilinear look-ups of many vectors: first where, then what is there.

A look-up is one chain of about 70 cycles: a division, rounding, the index, a load, three interpolations.  A processor
with AVX2 overlaps little of it, because the waiting instructions of one look-up fill its scheduler (64 entries for
vectors with Zen 3), and it learns no address before the chain is half through.  Two loops avoid both.  The first one
calculates the places of some vectors and gives hints which of them to fetch; the second one loads and interpolates.  It
takes the indices from memory one by one, which costs less than to extract them from a vector.  On a Zen 3 a voxel whose
data lie in the first cache takes 3.5 cycles instead of 6.4.  With AVX-512, one loop picks the lanes out of whole rows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from llvmlite import ir

from tomopose.engines.vector.lanes import (
    I32,
    I64,
    VF,
    VI,
    W,
    call,
    cgutils,
    fetch,
    neighbours,
    one_by_one,
    splat,
)

Bilinear: TypeAlias = tuple[ir.Value, ir.Value, ir.Value]
"""Value and slopes along a and b, W lanes each."""

TWO_LOOPS = W < 16
"""Whether places are calculated before the first of them is looked up."""


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """Look-ups i of W lanes each.

    data, count, row: the array, the number of its elements, and the length of a row (int32).  place(i): (a, b, *kept),
    positions that count rows and elements from data[base(i)].  use(i, (value, slope_a, slope_b), kept): takes what is
    there.  block: look-ups whose places are calculated together.  far: the array is larger than a cache.
    """

    data: ir.Value
    count: ir.Value
    row: ir.Value
    base: Callable[[ir.Value], ir.Value]
    place: Callable[[ir.Value], tuple[ir.Value, ...]]
    use: Callable[[ir.Value, Bilinear, Sequence[ir.Value]], None]
    block: int
    far: bool


def _bilinear(builder: ir.IRBuilder, corners: tuple[ir.Value, ...], f_a: ir.Value, f_b: ir.Value) -> Bilinear:
    """The value at fractions f_a, f_b between four corners as `neighbours` gives them, and its slopes along a and b.

    What nobody uses is not compiled.
    """
    p00, p01, p10, p11 = corners
    rise_low, rise_high = builder.fsub(p01, p00), builder.fsub(p11, p10)
    low = call(builder, "fma", f_b, rise_low, p00)
    high = call(builder, "fma", f_b, rise_high, p10)
    slope_a = builder.fsub(high, low)
    slope_b = call(builder, "fma", f_a, builder.fsub(rise_high, rise_low), rise_low)
    return call(builder, "fma", f_a, slope_a, low), slope_a, slope_b


class _Table:
    """A block of vectors of W lanes, on the stack."""

    def __init__(self, builder: ir.IRBuilder, kind: ir.Type, size: int) -> None:
        self.builder, self.kind = builder, kind
        self.data = cgutils.alloca_once(builder, kind, ir.Constant(I32, size))

    def _place(self, i: ir.Value) -> ir.Value:
        return self.builder.gep(self.data, [i], source_etype=self.kind)

    def put(self, i: ir.Value, vector: ir.Value) -> None:
        self.builder.store(vector, self._place(i))

    def get(self, i: ir.Value) -> ir.Value:
        return self.builder.load(self._place(i), typ=self.kind)

    def lanes(self, i: ir.Value) -> list[ir.Value]:
        """Vector i of int32, each lane loaded by itself, as int64."""
        element = self.kind.element
        first = self.builder.bitcast(self._place(i), element.as_pointer())
        places = (self.builder.gep(first, [ir.Constant(I64, lane)], source_etype=element) for lane in range(W))
        return [self.builder.sext(self.builder.load(place, typ=element), I64) for place in places]


def _found(builder: ir.IRBuilder, a: ir.Value, b: ir.Value) -> tuple[ir.Value, ir.Value, ir.Value, ir.Value]:
    """Whole parts (int32) and fractions of positions: i_a, i_b, f_a, f_b."""
    floor_a, floor_b = call(builder, "floor", a), call(builder, "floor", b)
    f_a, f_b = builder.fsub(a, floor_a), builder.fsub(b, floor_b)
    return builder.fptosi(floor_a, VI), builder.fptosi(floor_b, VI), f_a, f_b


def _fetch_ends(builder: ir.IRBuilder, wanted: Wanted, base: ir.Value, offset: ir.Value) -> None:
    """Hints to fetch both rows of the first and the last lane: the lanes between them are mostly in the same lines."""
    for lane in (0, W - 1):
        start = builder.add(base, builder.sext(builder.extract_element(offset, ir.Constant(I32, lane)), I64))
        fetch(builder, wanted.data, start, write=False)
        fetch(builder, wanted.data, builder.add(start, builder.sext(wanted.row, I64)), write=False)


def _in_two_loops(builder: ir.IRBuilder, wanted: Wanted, start: ir.Value, end: ir.Value) -> None:
    one, many = ir.Constant(I64, 1), ir.Constant(I64, wanted.block)
    offsets = _Table(builder, VI, wanted.block)
    with cgutils.for_range_slice(builder, start, end, many, I64) as (first, _number):
        stop = builder.add(first, many)
        stop = builder.select(builder.icmp_signed("<", stop, end), stop, end)
        with cgutils.for_range_slice(builder, first, stop, one, I64) as (i, _number):
            slot = builder.sub(i, first)
            a, b, *kept = wanted.place(i)
            i_a, i_b, f_a, f_b = _found(builder, a, b)
            offset = builder.add(builder.mul(i_a, splat(builder, wanted.row)), i_b)
            offsets.put(slot, offset)
            tables = [_Table(builder, VF, wanted.block) for _ in (f_a, f_b, *kept)]
            for table, vector in zip(tables, (f_a, f_b, *kept), strict=True):
                table.put(slot, vector)
            if wanted.far:
                _fetch_ends(builder, wanted, wanted.base(i), offset)
        with cgutils.for_range_slice(builder, first, stop, one, I64) as (i, _number):
            slot = builder.sub(i, first)
            corners = one_by_one(builder, wanted.data, wanted.base(i), wanted.row, offsets.lanes(slot))
            f_a, f_b, *kept = (table.get(slot) for table in tables)
            wanted.use(i, _bilinear(builder, corners, f_a, f_b), kept)


def look_up(builder: ir.IRBuilder, wanted: Wanted, start: ir.Value, end: ir.Value) -> None:
    """What is wanted, for start <= i < end."""
    if TWO_LOOPS:
        _in_two_loops(builder, wanted, start, end)
        return
    with cgutils.for_range_slice(builder, start, end, ir.Constant(I64, 1), I64) as (i, _number):
        a, b, *kept = wanted.place(i)
        i_a, i_b, f_a, f_b = _found(builder, a, b)
        corners = neighbours(builder, wanted.data, wanted.count, wanted.base(i), wanted.row, i_a, i_b)
        wanted.use(i, _bilinear(builder, corners, f_a, f_b), kept)
