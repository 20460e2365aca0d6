"""Asking for a cache line before it is needed: the one thing a compiler will not do by itself.

Searches that visit nodes in no particular order wait for memory at each of them; asking a dozen
nodes in advance lets those waits overlap. Listed in `gaussians.kernel_cache`.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir  # type: ignore[import-untyped] # has no stubs
from numba import types
from numba.extending import intrinsic, overload
from numpy.typing import NDArray


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
