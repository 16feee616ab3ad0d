"""LLVM vector building blocks of the CPU kernels: W voxels of a column, or W rays of adjacent detector rows, at a time.

Numba's own vectoriser turns neither the bilinear look-up of back-projection nor Joseph's into vector code, because the
loads are gathers and the stores may alias.  The blocks below say it to LLVM directly.  A bilinear look-up takes two
loads a lane, the pair of neighbours along the fastest axis as one 64 bit word; with AVX-512 most blocks take four whole
rows and a permutation instead.  LLVM maps the vectors to whatever the processor has; W is 16 with AVX-512 and 8
elsewhere.  The same results come from the plain kernels in back_projection.py and
forward_projection.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import llvmlite.binding
from llvmlite import ir
from numba import types
from numba.core import cgutils as untyped_cgutils
from numba.extending import intrinsic as untyped_intrinsic

# numba is typed in parts only; what a checker would take from those parts is wrong for code generation.
cgutils: Any = untyped_cgutils
intrinsic: Callable[[Callable[..., object]], Callable[..., None]] = untyped_intrinsic

tuple_of: Callable[[types.Type, int], types.Type] = types.UniTuple

Context: TypeAlias = Any
"""numba's typing or code generation context, and what an intrinsic hands over: numba has no types for them."""
Signature: TypeAlias = Any
Arguments: TypeAlias = Sequence[ir.Value]
Block: TypeAlias = Callable[..., None]
Intrinsic: TypeAlias = tuple[Signature, Callable[..., ir.Value]]

F32, I32, I64 = ir.FloatType(), ir.IntType(32), ir.IntType(64)


def _host_width() -> int:
    try:
        features = llvmlite.binding.get_host_cpu_features()
    except RuntimeError:  # the host is unknown to LLVM
        return 8
    return 16 if features.get("avx512f") else 8


W = _host_width()
"""Lanes of a vector."""

BIAS = 1 << 30
VF, VI = ir.VectorType(F32, W), ir.VectorType(I32, W)


def _splat(builder: ir.IRBuilder, x: ir.Value) -> ir.Value:
    vector = ir.VectorType(x.type, W)
    one = builder.insert_element(ir.Constant(vector, ir.Undefined), x, ir.Constant(I32, 0))
    return builder.shuffle_vector(one, ir.Constant(vector, ir.Undefined), ir.Constant(VI, [0] * W))


def _call(builder: ir.IRBuilder, name: str, *arguments: ir.Value) -> ir.Value:
    kind = ir.FunctionType(VF, [VF] * len(arguments))
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{W}f32"), arguments)


def _data(context: Context, builder: ir.IRBuilder, array_type: types.Type, array: ir.Value) -> ir.Value:
    return cgutils.create_struct_proxy(array_type)(context, builder, array).data


def _count(context: Context, builder: ir.IRBuilder, array_type: types.Type, array: ir.Value) -> ir.Value:
    return cgutils.create_struct_proxy(array_type)(context, builder, array).nitems


def _at(builder: ir.IRBuilder, data: ir.Value, index: ir.Value, kind: ir.Type) -> ir.Value:
    return builder.bitcast(builder.gep(data, [index], source_etype=F32), kind.as_pointer())


def _load(builder: ir.IRBuilder, data: ir.Value, index: ir.Value) -> ir.Value:
    return builder.load(_at(builder, data, index, VF), align=4, typ=VF)


def _pairs(builder: ir.IRBuilder, data: ir.Value, base: ir.Value, offset: ir.Value) -> tuple[ir.Value, ir.Value]:
    """Lane by lane, data[base + offset] and its right neighbour."""
    words = ir.Constant(ir.VectorType(I64, W), ir.Undefined)
    # With a bias the offsets are positive, and widening an unsigned lane to an address costs nothing.
    start = builder.gep(data, [builder.sub(base, ir.Constant(I64, BIAS))], source_etype=F32)
    offset = builder.add(offset, ir.Constant(VI, [BIAS] * W))
    for lane in range(W):
        o = builder.zext(builder.extract_element(offset, ir.Constant(I32, lane)), I64)
        word = builder.load(_at(builder, start, o, I64), align=4, typ=I64)
        words = builder.insert_element(words, word, ir.Constant(I32, lane))
    both = builder.bitcast(words, ir.VectorType(F32, 2 * W))
    undefined = ir.Constant(both.type, ir.Undefined)
    even = ir.Constant(VI, list(range(0, 2 * W, 2)))
    odd = ir.Constant(VI, list(range(1, 2 * W, 2)))
    return builder.shuffle_vector(both, undefined, even), builder.shuffle_vector(both, undefined, odd)


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
        low, high = _load(builder, data, start), _load(builder, data, builder.add(start, width))
        picked.append((_pick(builder, low, high, d_b), _pick(builder, low, high, builder.add(d_b, one))))
        start = builder.add(start, step)
    if rows == 2:
        return (*picked[0], *picked[1])
    upper = builder.icmp_unsigned("==", d_a, one)
    return tuple(builder.select(upper, picked[r + 1][side], picked[r][side]) for r in (0, 1) for side in (0, 1))


def _neighbours(
    builder: ir.IRBuilder, data: ir.Value, count: ir.Value, base: ir.Value, row: ir.Value, i_a: ir.Value, i_b: ir.Value
) -> tuple[ir.Value, ...]:
    """data at (i_a, i_b), (i_a, i_b + 1), (i_a + 1, i_b), (i_a + 1, i_b + 1), lane by lane.

    Adjacent lanes mostly want adjacent elements.  With AVX-512, lanes that share a row (or two) and 31 columns are
    picked out of whole rows; other lanes are loaded pair by pair.  No row is read beyond `count` elements.
    """

    def one_by_one() -> tuple[ir.Value, ...]:
        offset = builder.add(builder.mul(i_a, _splat(builder, row)), i_b)
        return (
            *_pairs(builder, data, base, offset),
            *_pairs(builder, data, builder.add(base, builder.sext(row, I64)), offset),
        )

    if W != 16:
        return one_by_one()
    found = [cgutils.alloca_once(builder, VF) for _ in range(4)]

    def keep(values: tuple[ir.Value, ...]) -> None:
        for place, value in zip(found, values, strict=True):
            builder.store(value, place)

    def smaller_end(index: ir.Value) -> ir.Value:
        first, last = (builder.extract_element(index, ir.Constant(I32, lane)) for lane in (0, W - 1))
        return builder.select(builder.icmp_signed("<", first, last), first, last)

    a_0, b_0 = smaller_end(i_a), smaller_end(i_b)
    d_a, d_b = builder.sub(i_a, _splat(builder, a_0)), builder.sub(i_b, _splat(builder, b_0))
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
                keep(one_by_one())
    return tuple(builder.load(place, typ=VF) for place in found)


def _bilinear(
    builder: ir.IRBuilder, data: ir.Value, count: ir.Value, base: ir.Value, row: ir.Value, a: ir.Value, b: ir.Value
) -> ir.Value:
    """data at the fractional position (a, b): a counts rows of length `row` (int32), b is the contiguous axis."""
    return _bilinear_with_slopes(builder, data, count, base, row, a, b)[0]


def _bilinear_with_slopes(
    builder: ir.IRBuilder, data: ir.Value, count: ir.Value, base: ir.Value, row: ir.Value, a: ir.Value, b: ir.Value
) -> tuple[ir.Value, ir.Value, ir.Value]:
    """data at (a, b) as `_bilinear` gives it, and its slopes along a and b; what nobody uses is not compiled."""
    floor_a, floor_b = _call(builder, "floor", a), _call(builder, "floor", b)
    f_a, f_b = builder.fsub(a, floor_a), builder.fsub(b, floor_b)
    p00, p01, p10, p11 = _neighbours(
        builder, data, count, base, row, builder.fptosi(floor_a, VI), builder.fptosi(floor_b, VI)
    )
    rise_low, rise_high = builder.fsub(p01, p00), builder.fsub(p11, p10)
    low = _call(builder, "fma", f_b, rise_low, p00)
    high = _call(builder, "fma", f_b, rise_high, p10)
    slope_a = builder.fsub(high, low)
    slope_b = _call(builder, "fma", f_a, builder.fsub(rise_high, rise_low), rise_low)
    return _call(builder, "fma", f_a, slope_a, low), slope_a, slope_b


def _weighted_pixels(
    builder: ir.IRBuilder,
    pixels: ir.Value,
    count: ir.Value,
    base: ir.Value,
    row: ir.Value,
    first: ir.Value,
    place: ir.Value,
    inverse_square: bool,
) -> tuple[ir.Value, ir.Value]:
    """(pixel values, weights) of W voxels; lanes below `first` look up the place of lane `first` and weigh nothing."""
    scale, u, du, v, dv, w, dw = cgutils.unpack_tuple(builder, place, 7)
    lanes = ir.Constant(VF, [float(lane) for lane in range(W)])
    start = _splat(builder, builder.sitofp(first, F32))
    active = builder.fcmp_ordered(">=", lanes, start)
    lane = builder.select(active, lanes, start)

    def along(origin: ir.Value, step: ir.Value) -> ir.Value:
        return _call(builder, "fma", lane, _splat(builder, step), _splat(builder, origin))

    reciprocal = builder.fdiv(ir.Constant(VF, [1.0] * W), along(w, dw))
    a, b = builder.fmul(along(u, du), reciprocal), builder.fmul(along(v, dv), reciprocal)
    value = _bilinear(builder, pixels, count, base, row, a, b)
    weight = _splat(builder, scale)
    if inverse_square:
        weight = builder.fmul(weight, builder.fmul(reciprocal, reciprocal))
    return value, builder.select(active, weight, ir.Constant(VF, [0.0] * W))


def _back_block(inverse_square: bool) -> Block:
    @intrinsic
    def block(
        typingctx: Context,
        column: types.Type,
        z: types.Type,
        image: types.Type,
        base: types.Type,
        row: types.Type,
        first: types.Type,
        place: types.Type,
    ) -> Intrinsic:
        """column[z + l] += weight * image at ((u + l du) / (w + l dw), (v + l dv) / (w + l dw)), lanes first <= l < W.

        place: (scale, u, du, v, dv, w, dw), float32.  image[base] is the pixel the two quotients count from; weight is
        `scale`, or scale / (w + l dw)^2.
        """
        signature = types.void(
            column, types.int64, image, types.int64, types.int32, types.int32, tuple_of(types.float32, 7)
        )

        def generate(context: Context, builder: ir.IRBuilder, signature: Signature, arguments: Arguments) -> ir.Value:
            column, z, image, base, row, first, place = arguments
            target = _data(context, builder, signature.args[0], column)
            pixels = _data(context, builder, signature.args[2], image)
            count = _count(context, builder, signature.args[2], image)
            value, weight = _weighted_pixels(builder, pixels, count, base, row, first, place, inverse_square)
            result = _call(builder, "fma", value, weight, _load(builder, target, z))
            builder.store(result, _at(builder, target, z, VF), align=4)
            return context.get_dummy_value()

        return signature, generate

    return block


back_block = _back_block(inverse_square=False)
back_block_inverse_square = _back_block(inverse_square=True)


def _held(builder: ir.IRBuilder, place: ir.Value, end: ir.Value) -> ir.Value:
    """Positions held within [-1, end]."""
    low = ir.Constant(VF, [-1.0] * W)
    place = builder.select(builder.fcmp_ordered(">", place, low), place, low)
    return builder.select(builder.fcmp_ordered("<", place, end), place, end)


Terms = Callable[..., tuple[ir.Value, ...]]
"""(builder, voxels, count, start, row, at_a, at_b, k - centre) -> what is summed over the planes, W lanes each."""


def _sums_of_rays(typed: tuple[types.Type, types.Type, types.Type], number: int, terms: Terms) -> Intrinsic:
    """The walk of `forward_block` and `derivative_block`: `number` sums for each of W rays, one after the other.

    typed: types of volume, rays and sums.
    """
    volume, rays, sums = typed
    signature = types.void(
        volume,
        types.int64,
        types.int64,
        types.int32,
        rays,
        tuple_of(types.int64, 2),
        tuple_of(types.float32, 3),
        sums,
    )

    def generate(context: Context, builder: ir.IRBuilder, signature: Signature, arguments: Arguments) -> ir.Value:
        volume, base, plane, row, rays, planes, ends, sums = arguments
        voxels = _data(context, builder, signature.args[0], volume)
        count = _count(context, builder, signature.args[0], volume)
        table = _data(context, builder, signature.args[4], rays)
        target = _data(context, builder, signature.args[7], sums)
        k_0, k_1 = cgutils.unpack_tuple(builder, planes, 2)
        centre, a_end, b_end = cgutils.unpack_tuple(builder, ends, 3)
        a, da, b, db = (_load(builder, table, ir.Constant(I64, i * W)) for i in range(4))
        a_end, b_end = _splat(builder, a_end), _splat(builder, b_end)
        totals = [cgutils.alloca_once_value(builder, ir.Constant(VF, [0.0] * W)) for _ in range(number)]
        with cgutils.for_range_slice(builder, k_0, k_1, ir.Constant(I64, 1), I64) as (k, _number):
            step = _splat(builder, builder.fsub(builder.sitofp(k, F32), centre))
            at_a = _held(builder, _call(builder, "fma", step, da, a), a_end)
            at_b = _held(builder, _call(builder, "fma", step, db, b), b_end)
            start = builder.add(base, builder.mul(k, plane))
            for total, term in zip(totals, terms(builder, voxels, count, start, row, at_a, at_b, step), strict=True):
                builder.store(builder.fadd(builder.load(total, typ=VF), term), total)
        for i, total in enumerate(totals):
            builder.store(builder.load(total, typ=VF), _at(builder, target, ir.Constant(I64, i * W), VF), align=4)
        return context.get_dummy_value()

    return signature, generate


def _value(builder: ir.IRBuilder, *place: ir.Value) -> tuple[ir.Value, ...]:
    return (_bilinear(builder, *place[:-1]),)


def _value_and_slopes(builder: ir.IRBuilder, *place: ir.Value) -> tuple[ir.Value, ...]:
    value, slope_a, slope_b = _bilinear_with_slopes(builder, *place[:-1])
    step = place[-1]
    return value, slope_a, builder.fmul(step, slope_a), slope_b, builder.fmul(step, slope_b)


def _ray_block(number: int, terms: Terms) -> Block:
    @intrinsic
    def block(
        typingctx: Context,
        volume: types.Type,
        base: types.Type,
        plane: types.Type,
        row: types.Type,
        rays: types.Type,
        planes: types.Type,
        ends: types.Type,
        sums: types.Type,
    ) -> Intrinsic:
        """sums[i W + l] = sum over planes k_0 <= k < k_1 of term i of the volume at (a_l(k), b_l(k)), for W rays.

        volume[base] is voxel (0, 0) of plane 0; planes lie `plane` elements apart, rows along a `row` (int32), b is
        contiguous.  rays holds a, da, b, db for each lane (4 W values): a(k) = a + (k - centre) da.  planes: (k_0,
        k_1);  ends: (centre, a_end, b_end), float32.  Positions are held within [-1, a_end] and [-1, b_end], where the
        volume's margin is zero.
        """
        return _sums_of_rays((volume, rays, sums), number, terms)

    return block


forward_block = _ray_block(1, _value)
"""Joseph's sums: one term, the volume f."""
derivative_block = _ray_block(5, _value_and_slopes)
"""The same walk with the slopes: five terms, f, df/da, (k - centre) df/da, df/db and (k - centre) df/db."""
