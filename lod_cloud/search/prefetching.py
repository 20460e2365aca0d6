"""Asking for a cache line before it is needed: the one thing a compiler will not do by itself.

Searches that visit nodes in no particular order wait for memory at each of them; asking a dozen
nodes in advance lets those waits overlap. `gather` does so for a batch of nodes and puts their
records side by side. Listed in `gaussians.kernel_cache`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped] # has no stubs
from numba import njit, types
from numba.extending import intrinsic, overload
from numpy.typing import NDArray

from lod_cloud.search.marks import is_set
from lod_cloud.search_arrays import RECORD_COLUMNS

BATCH = 256  # nodes gathered together
_AHEAD = 24  # nodes whose record is asked for in advance


def prefetch(array: NDArray[Any], index: int) -> None:
    """Ask for the cache line of element ``index`` of a contiguous array of any type and shape,
    counted flat; changes no value. The index must lie within the array.
    """


@intrinsic
def _ask(_context: Any, array: Any, index: Any) -> Any:
    def emit(context: Any, builder: Any, call: Any, values: Any) -> Any:
        data = context.make_array(call.args[0])(context, builder, values[0]).data
        address = builder.bitcast(builder.gep(data, [values[1]]), ir.IntType(8).as_pointer())
        number = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [address.type, number, number, number])
        function = builder.module.declare_intrinsic("llvm.prefetch", [address.type], kind)
        read, near, of_data = (ir.Constant(number, n) for n in (0, 3, 1))
        builder.call(function, [address, read, near, of_data])
        return context.get_dummy_value()

    return types.void(array, types.intp), emit


@overload(prefetch)
def _prefetch(array: Any, index: Any) -> Any:
    if not (isinstance(array, types.Array) and array.layout == "C"):
        return None

    def ask(array: Any, index: Any) -> Any:
        _ask(array, index)  # type: ignore[call-arg] # the context is the compiler's

    return ask


@njit(forceinline=True)
def gather(nodes, begin, end, records, refined, rows, was):  # type: ignore[no-untyped-def]
    """Records of up to BATCH of nodes[begin:end], number by number: x, y, z, R, e to
    ``rows`` [5, BATCH], whether refined to ``was`` [BATCH]; how many.

    Side by side they are what a compiler turns into vector instructions.
    """
    held = min(BATCH, end - begin)
    for i in range(held):
        later = np.intp(nodes[min(begin + i + _AHEAD, end - 1)])
        prefetch(records, later * RECORD_COLUMNS)
        prefetch(refined, later >> 3)
        node = np.intp(nodes[begin + i])
        for column in range(5):
            rows[column, i] = records[node, column]
        was[i] = is_set(refined, node)
    return held
