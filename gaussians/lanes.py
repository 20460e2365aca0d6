"""Sixteen float32 numbers side by side: what a kernel keeps in one vector register.

A kernel that works on lanes is written once. Compiled, its values are LLVM vectors of float32
(`Lanes`) and of bits (`Mask`): one register each where the processor has 512-bit vectors, several
shorter ones elsewhere. With numba's compiler off they are NumPy arrays, and the functions below
are what they say. Both ways every lane is rounded on its own, operation by operation: nothing is
fused or reordered, so the bits are the same on every machine.

A *pair* is twice as wide: two independent computations that a processor overlaps, where one alone
would wait for its own results. Besides the functions below, `+ - *` (of lanes, or of lanes and a
float32), `< <= >=` and, on masks, `& | ~` work as on arrays.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any, SupportsIndex, TypeAlias

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped] # has no stubs
from numba import types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import lower_builtin, models, register_model
from numpy.typing import NDArray

Lanes: TypeAlias = NDArray[np.float32]  # [16], a pair [32]
Mask: TypeAlias = NDArray[np.bool_]  # [16], a pair [32]
Float32 = NDArray[np.float32]

WIDTH = 16


# ---------------------------------------------------------------- as NumPy


def broadcast(value: np.float32) -> Lanes:
    """The same number in every lane."""
    return np.full(WIDTH, value, np.float32)


def pair(first: Any, second: Any) -> Lanes:
    """Two lots of lanes, or one float32 in all lanes of each half."""
    return np.concatenate([np.broadcast_to(half, WIDTH) for half in (first, second)])


def halves(both: Any) -> tuple[Any, Any]:
    """The first and the second half of a pair of lanes or masks."""
    return both[:WIDTH], both[WIDTH:]


def load(array: Float32, start: SupportsIndex) -> Lanes:
    """array[start : start + 16] of a contiguous float32 array of any shape, counted flat."""
    return array.reshape(-1)[start:][:WIDTH].copy()


def store(array: Float32, start: SupportsIndex, lanes: Lanes) -> None:
    """array[start : start + 16] = lanes, counted as in `load`."""
    array.reshape(-1)[start:][:WIDTH] = lanes


def select(mask: Mask, lanes: Lanes, otherwise: np.float32 | Lanes) -> Lanes:
    """Lane by lane, the first where the mask is set, else the second."""
    return np.where(mask, lanes, otherwise)


def minimum(lanes: Lanes, limit: np.float32) -> Lanes:
    """The smaller of two numbers that are not NaN, lane by lane."""
    return np.minimum(lanes, limit)


def count(mask: Mask) -> int:
    """Number of lanes that are set."""
    return int(np.count_nonzero(mask))


def bits(mask: Mask) -> int:
    """The lanes of a mask (not of a pair) as the bits of a number, the first lane lowest."""
    return int(np.packbits(mask, bitorder="little").view(np.uint16)[0])


def lowest_bit(number: int) -> int:
    """Place of the lowest bit that is set, 0 for the number 1; of a number > 0."""
    return (int(number) & -int(number)).bit_length() - 1


def highest_bit(number: int) -> int:
    """Place of the highest bit that is set; of a number > 0."""
    return int(number).bit_length() - 1


def scaled(value: Any, exponent: Any) -> Any:
    """value * 2**k, for lanes or one float32; ``exponent`` is the float32 number 1.5*2**23 + k.

    The bits of that number end in k, so shifting them left makes the exponent of 2**k.
    """
    bits = np.asarray(exponent).view(np.int32) << np.int32(23)
    return value * (bits + np.int32(127 << 23)).view(np.float32)[()]


def prefetch(array: NDArray[Any], start: SupportsIndex) -> None:
    """Ask for the cache line of array[start], counted as in `load`, of any type; changes no value.

    Of an array that is not contiguous it asks for the wrong line, which costs time only.
    """


# ---------------------------------------------------------------- as LLVM vectors


class _Vector(types.Type):
    """numba's handle of an LLVM vector type."""

    def __init__(self, element: Any, width: int) -> None:
        self.vector = ir.VectorType(element, width)
        super().__init__(str(self.vector))


@register_model(_Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, kind.vector)


_FLOAT, _INT, _BIT = ir.FloatType(), ir.IntType(32), ir.IntType(1)
_LANES, _MASK = _Vector(_FLOAT, WIDTH), _Vector(_BIT, WIDTH)
_PAIR, _PAIR_MASK = _Vector(_FLOAT, 2 * WIDTH), _Vector(_BIT, 2 * WIDTH)
_NUMBER = types.float32

Emit: TypeAlias = Callable[..., Any]  # (context, builder, signature, values) -> value


def _implement(function: Any, result: Any, *arguments: Any) -> Callable[[Emit], Emit]:
    """Let the decorated function emit ``function(*arguments)``, which then has type ``result``."""

    def fits(given: Any, wanted: Any) -> bool:
        if wanted is not types.Array:
            return bool(given == wanted)
        numbers = getattr(given, "layout", "") == "C" and given.dtype == _NUMBER
        return isinstance(given, types.Array) and (numbers or function is prefetch)

    class Typing(AbstractTemplate):
        key = function

        def generic(self, given: Any, _keywords: Any) -> Any:
            if len(given) == len(arguments) and all(map(fits, given, arguments)):
                return signature(result, *given)
            return None

    def decorate(emit: Emit) -> Emit:
        infer_global(function)(Typing)
        lower_builtin(function, *arguments)(emit)
        return emit

    return decorate


def _picked(builder: Any, first: Any, second: Any, places: range | list[int]) -> Any:
    """The elements of two vectors, one after the other, at these places."""
    indices = ir.Constant(ir.VectorType(_INT, len(places)), list(places))
    return builder.shuffle_vector(first, second, indices)


def _wide(builder: Any, value: Any, vector: Any = _LANES.vector) -> Any:
    """A scalar in every lane; what is a vector already stays as it is."""
    if isinstance(value.type, ir.VectorType):
        return value
    nothing = ir.Constant(vector, ir.Undefined)
    first = builder.insert_element(nothing, value, ir.Constant(_INT, 0))
    return _picked(builder, first, nothing, [0] * vector.count)


def _operator(function: Any, result: Any, name: str, *arguments: Any) -> None:
    vector = next(kind.vector for kind in arguments if isinstance(kind, _Vector))

    @_implement(function, result, *arguments)
    def emit(_context: Any, builder: Any, _signature: Any, values: Any) -> Any:
        wide = [_wide(builder, value, vector) for value in values]
        if name in ("<", "<=", ">="):
            return builder.fcmp_ordered(name, *wide)
        return getattr(builder, name)(*wide)


for _lanes, _mask in ((_LANES, _MASK), (_PAIR, _PAIR_MASK)):
    for _f, _name in ((operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul")):
        _operator(_f, _lanes, _name, _lanes, _lanes)
        _operator(_f, _lanes, _name, _lanes, _NUMBER)
        _operator(_f, _lanes, _name, _NUMBER, _lanes)
    for _f, _name in ((operator.lt, "<"), (operator.le, "<="), (operator.ge, ">=")):
        _operator(_f, _mask, _name, _lanes, _lanes)
        _operator(_f, _mask, _name, _lanes, _NUMBER)
    _operator(operator.and_, _mask, "and_", _mask, _mask)
    _operator(operator.or_, _mask, "or_", _mask, _mask)
    _operator(operator.invert, _mask, "not_", _mask)

    @_implement(select, _lanes, _mask, _lanes, _lanes)
    @_implement(select, _lanes, _mask, _lanes, _NUMBER)
    def _select(_context: Any, builder: Any, _signature: Any, values: Any) -> Any:
        mask, lanes, otherwise = values
        return builder.select(mask, lanes, _wide(builder, otherwise, lanes.type))

    @_implement(minimum, _lanes, _lanes, _NUMBER)
    def _minimum(_context: Any, builder: Any, _signature: Any, values: Any) -> Any:
        lanes, limit = values[0], _wide(builder, values[1], values[0].type)
        return builder.select(builder.fcmp_ordered("<", lanes, limit), lanes, limit)

    @_implement(count, types.intp, _mask)
    def _count(context: Any, builder: Any, _signature: Any, values: Any) -> Any:
        bits = builder.bitcast(values[0], ir.IntType(values[0].type.count))
        return builder.zext(builder.ctpop(bits), context.get_value_type(types.intp))


@_implement(bits, types.intp, _MASK)
def _bits(context: Any, builder: Any, _signature: Any, values: Any) -> Any:
    number = builder.bitcast(values[0], ir.IntType(WIDTH))
    return builder.zext(number, context.get_value_type(types.intp))


@_implement(lowest_bit, types.intp, types.intp)
def _lowest_bit(_context: Any, builder: Any, _signature: Any, values: Any) -> Any:
    return builder.cttz(values[0], ir.Constant(_BIT, 1))


@_implement(highest_bit, types.intp, types.intp)
def _highest_bit(_context: Any, builder: Any, _signature: Any, values: Any) -> Any:
    zeros = builder.ctlz(values[0], ir.Constant(_BIT, 1))
    return builder.sub(ir.Constant(zeros.type, zeros.type.width - 1), zeros)


for _kind in (_LANES, _PAIR, _NUMBER):

    @_implement(scaled, _kind, _kind, _kind)
    def _scaled(_context: Any, builder: Any, _signature: Any, values: Any) -> Any:
        value, exponent = values
        width = getattr(value.type, "count", 0)
        kind = ir.VectorType(_INT, width) if width else _INT
        shift, one = (ir.Constant(kind, [n] * width if width else n) for n in (23, 127 << 23))
        bits = builder.shl(builder.bitcast(exponent, kind), shift)
        return builder.fmul(value, builder.bitcast(builder.add(bits, one), value.type))


@_implement(broadcast, _LANES, _NUMBER)
def _broadcast(_context: Any, builder: Any, _signature: Any, values: Any) -> Any:
    return _wide(builder, values[0])


@_implement(pair, _PAIR, _LANES, _LANES)
@_implement(pair, _PAIR, _NUMBER, _NUMBER)
def _pair(_context: Any, builder: Any, _signature: Any, values: Any) -> Any:
    first, second = (_wide(builder, value) for value in values)
    return _picked(builder, first, second, range(2 * WIDTH))


for _both, _half in ((_PAIR, _LANES), (_PAIR_MASK, _MASK)):

    @_implement(halves, types.UniTuple(_half, 2), _both)
    def _halves(context: Any, builder: Any, call: Any, values: Any) -> Any:
        both = values[0]
        first, second = (
            _picked(builder, both, both, range(start, start + WIDTH)) for start in (0, WIDTH)
        )
        return context.make_tuple(builder, call.return_type, (first, second))


def _address(context: Any, builder: Any, call: Any, values: Any) -> Any:
    """Pointer to the 16 numbers that begin at a flat index of an array."""
    array = context.make_array(call.args[0])(context, builder, values[0])
    pointer = builder.gep(array.data, [values[1]])
    return builder.bitcast(pointer, _LANES.vector.as_pointer())


@_implement(load, _LANES, types.Array, types.intp)
def _load(context: Any, builder: Any, call: Any, values: Any) -> Any:
    return builder.load(_address(context, builder, call, values), align=4)


@_implement(store, types.none, types.Array, types.intp, _LANES)
def _store(context: Any, builder: Any, call: Any, values: Any) -> Any:
    builder.store(values[2], _address(context, builder, call, values), align=4)
    return context.get_dummy_value()


@_implement(prefetch, types.none, types.Array, types.intp)
def _prefetch(context: Any, builder: Any, call: Any, values: Any) -> Any:
    address = _address(context, builder, call, values)
    address = builder.bitcast(address, ir.IntType(8).as_pointer())
    kind = ir.FunctionType(ir.VoidType(), [address.type, _INT, _INT, _INT])
    function = builder.module.declare_intrinsic("llvm.prefetch", [address.type], kind)
    read, near, data = (ir.Constant(_INT, number) for number in (0, 3, 1))
    builder.call(function, [address, read, near, data])
    return context.get_dummy_value()
