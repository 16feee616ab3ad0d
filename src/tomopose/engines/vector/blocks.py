"""The compiled blocks that the CPU kernels call: voxels of a column, and rays of adjacent detector rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

from llvmlite import ir
from numba import types
from numba.extending import intrinsic as untyped_intrinsic

from tomopose.engines.vector.lanes import (
    F32,
    I64,
    VF,
    Context,
    W,
    at,
    call,
    cgutils,
    count_of,
    data_of,
    fetch,
    load,
    splat,
)
from tomopose.engines.vector.look_up import TWO_LOOPS, Bilinear, Wanted, look_up

# numba is typed in parts only: see lanes.py.
intrinsic: Callable[[Callable[..., object]], Callable[..., None]] = untyped_intrinsic

tuple_of: Callable[[types.Type, int], types.Type] = types.UniTuple

Signature: TypeAlias = Context
Arguments: TypeAlias = Sequence[ir.Value]
Block: TypeAlias = Callable[..., None]
Intrinsic: TypeAlias = tuple[Signature, Callable[..., ir.Value]]

BLOCKS = 16 if TWO_LOOPS else 1
"""Blocks of W voxels that a call takes; flat from 8 to 32 on benchmarks/reconstruction."""

PLANES = 64
"""Planes whose places are calculated together; flat from 64 to 128 on benchmarks/reconstruction, with 16 slower."""

AHEAD = 256
"""Voxels between a block and what is fetched meanwhile: about a column, the next one in memory."""


def _places(
    builder: ir.IRBuilder, lane: ir.Value, place: ir.Value, scale: ir.Value, inverse_square: bool
) -> tuple[ir.Value, ...]:
    """Positions (u, v) of W voxels, and with `inverse_square` their weights."""
    _scale, u, du, v, dv, w, dw = cgutils.unpack_tuple(builder, place, 7)

    def along(origin: ir.Value, step: ir.Value) -> ir.Value:
        return call(builder, "fma", lane, splat(builder, step), splat(builder, origin))

    reciprocal = builder.fdiv(ir.Constant(VF, [1.0] * W), along(w, dw))
    a, b = builder.fmul(along(u, du), reciprocal), builder.fmul(along(v, dv), reciprocal)
    if inverse_square:
        return a, b, builder.fmul(scale, builder.fmul(reciprocal, reciprocal))
    return a, b


def _back_blocks(inverse_square: bool) -> Block:
    @intrinsic
    def block(
        typingctx: Context,
        column: types.Type,
        z: types.Type,
        image: types.Type,
        base: types.Type,
        row: types.Type,
        lanes: types.Type,
        place: types.Type,
    ) -> Intrinsic:
        """column[z + l] += weight * image at ((u + l du) / (w + l dw), (v + l dv) / (w + l dw)), first <= l < W blocks.

        lanes: (first, blocks), blocks <= BLOCKS, and 1 where first > 0.  place: (scale, u, du, v, dv, w, dw), float32.
        image[base] is the pixel the two quotients count from; weight is `scale`, or scale / (w + l dw)^2.
        """
        signature = types.void(
            column,
            types.int64,
            image,
            types.int64,
            types.int32,
            tuple_of(types.int64, 2),
            tuple_of(types.float32, 7),
        )

        def generate(context: Context, builder: ir.IRBuilder, signature: Signature, arguments: Arguments) -> ir.Value:
            column, z, image, base, row, lanes, place = arguments
            target = data_of(context, builder, signature.args[0], column)
            first, blocks = cgutils.unpack_tuple(builder, lanes, 2)

            # Where first > 0 there is one block: what holds for its lanes holds for all.
            lanes = ir.Constant(VF, [float(lane) for lane in range(W)])
            start = splat(builder, builder.sitofp(first, F32))
            active = builder.fcmp_ordered(">=", lanes, start)
            lanes = builder.select(active, lanes, start)
            scale = splat(builder, builder.extract_value(place, 0))
            scale = builder.select(active, scale, ir.Constant(VF, [0.0] * W))

            def places(i: ir.Value) -> tuple[ir.Value, ...]:
                z_i = builder.mul(i, ir.Constant(I64, W))
                lane = lanes
                if TWO_LOOPS:
                    lane = builder.fadd(lanes, splat(builder, builder.sitofp(z_i, F32)))
                    fetch(builder, target, builder.add(builder.add(z, z_i), ir.Constant(I64, AHEAD)), write=True)
                return _places(builder, lane, place, scale, inverse_square)

            def add(i: ir.Value, found: Bilinear, kept: Sequence[ir.Value]) -> None:
                z_i = builder.add(z, builder.mul(i, ir.Constant(I64, W)))
                weight = kept[0] if inverse_square else scale
                result = call(builder, "fma", found[0], weight, load(builder, target, z_i))
                builder.store(result, at(builder, target, z_i, VF), align=4)

            wanted = Wanted(
                data=data_of(context, builder, signature.args[2], image),
                count=count_of(context, builder, signature.args[2], image),
                row=row,
                base=lambda i: base,
                place=places,
                use=add,
                block=BLOCKS,
                far=False,
            )
            look_up(builder, wanted, ir.Constant(I64, 0), blocks)
            return context.get_dummy_value()

        return signature, generate

    return block


back_blocks = _back_blocks(inverse_square=False)
back_blocks_inverse_square = _back_blocks(inverse_square=True)


def _held(builder: ir.IRBuilder, place: ir.Value, end: ir.Value) -> ir.Value:
    """Positions held within [-1, end]."""
    low = ir.Constant(VF, [-1.0] * W)
    place = builder.select(builder.fcmp_ordered(">", place, low), place, low)
    return builder.select(builder.fcmp_ordered("<", place, end), place, end)


Terms = Callable[[ir.IRBuilder, Bilinear, ir.Value], tuple[ir.Value, ...]]
"""(builder, (value, slope_a, slope_b), k - centre) -> what is summed over the planes, W lanes each."""


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
        table = data_of(context, builder, signature.args[4], rays)
        target = data_of(context, builder, signature.args[7], sums)
        k_0, k_1 = cgutils.unpack_tuple(builder, planes, 2)
        centre, a_end, b_end = cgutils.unpack_tuple(builder, ends, 3)
        a, da, b, db = (load(builder, table, ir.Constant(I64, i * W)) for i in range(4))
        a_end, b_end = splat(builder, a_end), splat(builder, b_end)
        totals = [cgutils.alloca_once_value(builder, ir.Constant(VF, [0.0] * W)) for _ in range(number)]

        def from_centre(k: ir.Value) -> ir.Value:
            return splat(builder, builder.fsub(builder.sitofp(k, F32), centre))

        def place(k: ir.Value) -> tuple[ir.Value, ...]:
            step = from_centre(k)
            along = ((a, da, a_end), (b, db, b_end))
            return tuple(_held(builder, call(builder, "fma", step, slope, middle), end) for middle, slope, end in along)

        def add(k: ir.Value, found: Bilinear, kept: Sequence[ir.Value]) -> None:
            for total, term in zip(totals, terms(builder, found, from_centre(k)), strict=True):
                builder.store(builder.fadd(builder.load(total, typ=VF), term), total)

        wanted = Wanted(
            data=data_of(context, builder, signature.args[0], volume),
            count=count_of(context, builder, signature.args[0], volume),
            row=row,
            base=lambda k: builder.add(base, builder.mul(k, plane)),
            place=place,
            use=add,
            block=PLANES,
            far=True,
        )
        look_up(builder, wanted, k_0, k_1)
        for i, total in enumerate(totals):
            builder.store(builder.load(total, typ=VF), at(builder, target, ir.Constant(I64, i * W), VF), align=4)
        return context.get_dummy_value()

    return signature, generate


def _value(builder: ir.IRBuilder, found: Bilinear, step: ir.Value) -> tuple[ir.Value, ...]:
    return found[:1]


def _value_and_slopes(builder: ir.IRBuilder, found: Bilinear, step: ir.Value) -> tuple[ir.Value, ...]:
    value, slope_a, slope_b = found
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
