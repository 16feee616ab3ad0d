"""What the vector kernels say to LLVM of single vectors: their width, loads, and four neighbours of each lane."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import llvmlite.binding
from llvmlite import ir
from numba import types
from numba.core import cgutils as untyped_cgutils

cgutils: Any = untyped_cgutils
"""numba is typed in parts only; what a checker would take from those parts is wrong for code generation."""

Context: TypeAlias = Any
"""numba's typing or code generation context, and what an intrinsic hands over: numba has no types for them."""
Corners: TypeAlias = tuple[ir.Value, ir.Value, ir.Value, ir.Value]
"""Lane by lane the values at (a, b), (a, b + 1), (a + 1, b) and (a + 1, b + 1)."""

F32, F64, I32, I64 = ir.FloatType(), ir.DoubleType(), ir.IntType(32), ir.IntType(64)


def _host_width() -> int:
    try:
        features = llvmlite.binding.get_host_cpu_features()
    except RuntimeError:  # the host is unknown to LLVM
        return 8
    return 16 if features.get("avx512f") else 8


W = _host_width()
"""Lanes of a vector."""

ORDER = tuple(range(W)) if W == 16 else (0, 1, 4, 5, 2, 3, 6, 7)
"""In which order lanes are loaded: of 8, so that neighbours separate within the halves of a 256 bit register."""

BIAS = 1 << 30
VF, VI = ir.VectorType(F32, W), ir.VectorType(I32, W)


def splat(builder: ir.IRBuilder, x: ir.Value) -> ir.Value:
    vector = ir.VectorType(x.type, W)
    one = builder.insert_element(ir.Constant(vector, ir.Undefined), x, ir.Constant(I32, 0))
    return builder.shuffle_vector(one, ir.Constant(vector, ir.Undefined), ir.Constant(VI, [0] * W))


def call(builder: ir.IRBuilder, name: str, *arguments: ir.Value) -> ir.Value:
    kind = ir.FunctionType(VF, [VF] * len(arguments))
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{W}f32"), arguments)


def data_of(context: Context, builder: ir.IRBuilder, array_type: types.Type, array: ir.Value) -> ir.Value:
    return cgutils.create_struct_proxy(array_type)(context, builder, array).data


def count_of(context: Context, builder: ir.IRBuilder, array_type: types.Type, array: ir.Value) -> ir.Value:
    return cgutils.create_struct_proxy(array_type)(context, builder, array).nitems


def at(builder: ir.IRBuilder, data: ir.Value, index: ir.Value, kind: ir.Type) -> ir.Value:
    return builder.bitcast(builder.gep(data, [index], source_etype=F32), kind.as_pointer())


def load(builder: ir.IRBuilder, data: ir.Value, index: ir.Value) -> ir.Value:
    return builder.load(at(builder, data, index, VF), align=4, typ=VF)


def fetch(builder: ir.IRBuilder, data: ir.Value, index: ir.Value, write: bool) -> None:
    """A hint to bring data[index] into the first cache, to be read or written; beyond the array it does nothing."""
    byte = ir.IntType(8).as_pointer()
    hint = ir.FunctionType(ir.VoidType(), [byte, I32, I32, I32])
    function = cgutils.get_or_insert_function(builder.module, hint, "llvm.prefetch.p0i8")
    how = [ir.Constant(I32, int(write)), ir.Constant(I32, 3), ir.Constant(I32, 1)]
    builder.call(function, [at(builder, data, index, ir.IntType(8)), *how])


def _pairs(
    builder: ir.IRBuilder, data: ir.Value, base: ir.Value, offsets: Sequence[ir.Value]
) -> tuple[ir.Value, ir.Value]:
    """data[base + offset] and its right neighbour; offsets: int64, one for each lane."""
    words = ir.Constant(ir.VectorType(F64, W), ir.Undefined)  # LLVM loads a float of 64 bits right into half a register
    start = builder.gep(data, [base], source_etype=F32)
    for place, lane in enumerate(ORDER):
        word = builder.load(at(builder, start, offsets[lane], F64), align=4, typ=F64)
        words = builder.insert_element(words, word, ir.Constant(I32, place))
    both = builder.bitcast(words, ir.VectorType(F32, 2 * W))
    undefined = ir.Constant(both.type, ir.Undefined)
    even = [2 * ORDER.index(lane) for lane in range(W)]
    odd = [1 + place for place in even]
    return (
        builder.shuffle_vector(both, undefined, ir.Constant(VI, even)),
        builder.shuffle_vector(both, undefined, ir.Constant(VI, odd)),
    )


def one_by_one(
    builder: ir.IRBuilder, data: ir.Value, base: ir.Value, row: ir.Value, offsets: Sequence[ir.Value]
) -> Corners:
    """The four neighbours of every lane, two pairs a lane; offsets as `_pairs` wants them."""
    below = builder.add(base, builder.sext(row, I64))
    return (*_pairs(builder, data, base, offsets), *_pairs(builder, data, below, offsets))


def _all(builder: ir.IRBuilder, mask: ir.Value) -> ir.Value:
    """Whether every lane of a mask is set."""
    bits = ir.IntType(W)
    return builder.icmp_unsigned("==", builder.bitcast(mask, bits), ir.Constant(bits, -1))


def _pick(builder: ir.IRBuilder, low: ir.Value, high: ir.Value, index: ir.Value) -> ir.Value:
    """Lanes of two vectors side by side, by index 0 .. 31 (AVX-512's vpermi2ps)."""
    kind = ir.FunctionType(VF, [VF, VI, VF])
    function = cgutils.get_or_insert_function(builder.module, kind, "llvm.x86.avx512.vpermi2var.ps.512")
    return builder.call(function, [low, index, high])


def _near(
    builder: ir.IRBuilder, data: ir.Value, start: ir.Value, row: ir.Value, d_a: ir.Value, d_b: ir.Value, rows: int
) -> tuple[ir.Value, ...]:
    """The four neighbours of lanes that lie within `rows` - 1 rows and 31 columns: whole rows loaded, lanes picked."""
    step = builder.sext(row, I64)
    one, width = ir.Constant(VI, [1] * W), ir.Constant(I64, W)
    picked = []
    for _ in range(rows):
        low, high = load(builder, data, start), load(builder, data, builder.add(start, width))
        picked.append((_pick(builder, low, high, d_b), _pick(builder, low, high, builder.add(d_b, one))))
        start = builder.add(start, step)
    if rows == 2:
        return (*picked[0], *picked[1])
    upper = builder.icmp_unsigned("==", d_a, one)
    return tuple(builder.select(upper, picked[r + 1][side], picked[r][side]) for r in (0, 1) for side in (0, 1))


def neighbours(
    builder: ir.IRBuilder, data: ir.Value, count: ir.Value, base: ir.Value, row: ir.Value, i_a: ir.Value, i_b: ir.Value
) -> tuple[ir.Value, ...]:
    """The four neighbours of every lane at row i_a and column i_b from data[base] on, with AVX-512.

    Adjacent lanes mostly want adjacent elements.  Lanes that share a row (or two) and 31 columns are picked out of
    whole rows; other lanes are loaded pair by pair.  No row is read beyond `count` elements.
    """

    def spread() -> Corners:
        # With a bias the offsets are positive, and widening an unsigned lane to an address costs nothing.
        offset = builder.add(builder.add(builder.mul(i_a, splat(builder, row)), i_b), ir.Constant(VI, [BIAS] * W))
        lanes = (builder.extract_element(offset, ir.Constant(I32, lane)) for lane in range(W))
        start = builder.sub(base, ir.Constant(I64, BIAS))
        return one_by_one(builder, data, start, row, [builder.zext(lane, I64) for lane in lanes])

    found = [cgutils.alloca_once(builder, VF) for _ in range(4)]

    def keep(values: tuple[ir.Value, ...]) -> None:
        for place, value in zip(found, values, strict=True):
            builder.store(value, place)

    def smaller_end(index: ir.Value) -> ir.Value:
        first, last = (builder.extract_element(index, ir.Constant(I32, lane)) for lane in (0, W - 1))
        return builder.select(builder.icmp_signed("<", first, last), first, last)

    a_0, b_0 = smaller_end(i_a), smaller_end(i_b)
    d_a, d_b = builder.sub(i_a, splat(builder, a_0)), builder.sub(i_b, splat(builder, b_0))
    step = builder.sext(row, I64)
    start = builder.add(base, builder.add(builder.mul(builder.sext(a_0, I64), step), builder.sext(b_0, I64)))
    end = builder.add(start, builder.add(builder.mul(step, ir.Constant(I64, 2)), ir.Constant(I64, 2 * W)))
    columns = _all(builder, builder.icmp_unsigned("<=", d_b, ir.Constant(VI, [2 * W - 2] * W)))
    columns = builder.and_(columns, builder.icmp_signed("<=", end, count))
    one_row = _all(builder, builder.icmp_unsigned("==", d_a, ir.Constant(VI, [0] * W)))
    two_rows = _all(builder, builder.icmp_unsigned("<=", d_a, ir.Constant(VI, [1] * W)))
    with builder.if_else(builder.and_(columns, one_row)) as (then, otherwise):
        with then:
            keep(_near(builder, data, start, row, d_a, d_b, 2))
        with otherwise, builder.if_else(builder.and_(columns, two_rows)) as (also, rest):
            with also:
                keep(_near(builder, data, start, row, d_a, d_b, 3))
            with rest:
                keep(spread())
    return tuple(builder.load(place, typ=VF) for place in found)
