"""LLVM vector blocks of the CPU kernels: W voxels of a column, or W rays of adjacent detector rows, at a time.

Numba's own vectoriser turns neither the bilinear look-up of back-projection nor Joseph's into vector code, because the
loads are gathers and the stores may alias.  The blocks say it to LLVM directly.  A bilinear look-up takes two loads a
lane, the pair of neighbours along the fastest axis as one 64 bit word; with AVX-512 most blocks take four whole rows
and a permutation instead.  LLVM maps the vectors to whatever the processor has; W is 16 with AVX-512 and 8 elsewhere.
The same results come from the plain kernels in back_projection.py and forward_projection.py.
"""

from tomopose.engines.vector.blocks import (
    BLOCKS,
    back_blocks,
    back_blocks_inverse_square,
    derivative_block,
    forward_block,
)
from tomopose.engines.vector.lanes import W

__all__ = ["BLOCKS", "W", "back_blocks", "back_blocks_inverse_square", "derivative_block", "forward_block"]
