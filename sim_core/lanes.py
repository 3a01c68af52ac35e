"""SIMD vectors for numba kernels: a vector holds eight numbers, one per lane.

LLVM does not vectorise the branchy loops of ORCA by itself. The extension type `LanesType(element)` makes the vectors
explicit: it is LLVM's `<8 x element>`, which LLVM lowers to the vector registers of the processor. A wide vector, of
sixteen numbers, fills a register of 512 bits, or two of 256.

Kernels read like scalar code. `+ - * /`, comparisons and `& | ^ ~ >>` work lane by lane; a scalar operand is broadcast
to all lanes. `select` replaces `if`, and `any_lane` tells whether any lane needs a branch. Elements are float32,
float64, whole numbers or, in masks, bool. Division and square root are IEEE 754's, so each lane gives the bits that
scalar code would give. Comparisons are ordered: with NaN every comparison is false, `!=` included.

Arrays are indexed flat: vector i of an array consists of its elements 8 i to 8 i + 7. `load_some` and `store_some` take
any elements in a row, of which there may be fewer than eight.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable

LANES = 8
"""Lanes of a vector: float32 fills one 256-bit register."""
WIDE = 16
"""Lanes of a wide vector."""


class LanesType(types.Type):
    """The numba type of a vector of `lanes` numbers of the numba type `element`."""

    def __init__(self, element: Any, lanes: int = LANES) -> None:
        self.element, self.lanes = element, lanes
        super().__init__(name=f"Lanes({element})" if lanes == LANES else f"Lanes({element}, {lanes})")


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: LanesType) -> None:
        element = dmm.lookup(fe_type.element).get_value_type()
        super().__init__(dmm, fe_type, ir.VectorType(element, fe_type.lanes))


def _splat(builder: Any, value: Any, lanes: int = LANES) -> Any:
    vector = ir.VectorType(value.type, lanes)
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    order = ir.Constant(ir.VectorType(ir.IntType(32), lanes), [0] * lanes)
    return builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), order)


def _broadcast(context: Any, builder: Any, value: Any, numba_type: Any, vector: LanesType) -> Any:
    """Returns `value`, of type `numba_type`, as a vector of type `vector`; a scalar is repeated in every lane."""
    if isinstance(numba_type, LanesType):
        return value
    return _splat(builder, context.cast(builder, value, numba_type, vector.element), vector.lanes)


def _common_vector(*arguments: Any) -> Any:
    """The type of the vectors among the arguments; None if they differ or a scalar does not fit it."""
    vectors = {argument for argument in arguments if isinstance(argument, LanesType)}
    scalars = [argument for argument in arguments if not isinstance(argument, LanesType)]
    if len(vectors) != 1 or not all(isinstance(scalar, types.Number) for scalar in scalars):
        return None
    vector = vectors.pop()
    if isinstance(vector.element, types.Integer) and any(isinstance(scalar, types.Float) for scalar in scalars):
        return None  # a cast would truncate the scalar
    return vector


def _is_float(element: Any) -> bool:
    return isinstance(element, types.Float)


def _is_signed(element: Any) -> bool:
    return bool(isinstance(element, types.Integer) and element.signed)


def _binary(operation: Any, emit: Callable[[Any, Any, Any, Any], Any], compares: bool) -> None:
    """Defines a binary operator on vectors. `emit(builder, element, a, b)` emits its LLVM instruction."""

    @type_callable(operation)
    def typed(context: Any) -> Any:
        def typer(a: Any, b: Any) -> Any:
            vector = _common_vector(a, b)
            if vector is None:
                return None
            return LanesType(types.boolean, vector.lanes) if compares else vector

        return typer

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        vector = _common_vector(*sig.args)
        a, b = (_broadcast(context, builder, v, t, vector) for v, t in zip(args, sig.args, strict=True))
        return emit(builder, vector.element, a, b)

    for left, right in ((LanesType, LanesType), (LanesType, types.Number), (types.Number, LanesType)):
        lower_builtin(operation, left, right)(lower)


def _compare(symbol: str) -> Callable[[Any, Any, Any, Any], Any]:
    def emit(builder: Any, element: Any, a: Any, b: Any) -> Any:
        if _is_float(element):
            return builder.fcmp_ordered(symbol, a, b)
        return (builder.icmp_signed if _is_signed(element) else builder.icmp_unsigned)(symbol, a, b)

    return emit


def _shift_right(builder: Any, element: Any, a: Any, b: Any) -> Any:
    return (builder.ashr if _is_signed(element) else builder.lshr)(a, b)


_binary(operator.add, lambda builder, element, a, b: (builder.fadd if _is_float(element) else builder.add)(a, b), False)
_binary(operator.sub, lambda builder, element, a, b: (builder.fsub if _is_float(element) else builder.sub)(a, b), False)
_binary(operator.mul, lambda builder, element, a, b: (builder.fmul if _is_float(element) else builder.mul)(a, b), False)
_binary(operator.truediv, lambda builder, _, a, b: builder.fdiv(a, b), False)
_binary(operator.and_, lambda builder, _, a, b: builder.and_(a, b), False)
_binary(operator.or_, lambda builder, _, a, b: builder.or_(a, b), False)
_binary(operator.xor, lambda builder, _, a, b: builder.xor(a, b), False)
_binary(operator.rshift, _shift_right, False)
for _operation, _symbol in (
    (operator.lt, "<"),
    (operator.le, "<="),
    (operator.gt, ">"),
    (operator.ge, ">="),
    (operator.eq, "=="),
    (operator.ne, "!="),
):
    _binary(_operation, _compare(_symbol), True)


def _unary(operation: Any, emit: Callable[[Any, Any], Any]) -> None:
    @type_callable(operation)
    def typed(context: Any) -> Any:
        return lambda a: a if isinstance(a, LanesType) else None

    @lower_builtin(operation, LanesType)
    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return emit(builder, args[0])


def _llvm_intrinsic(builder: Any, name: str, vector: Any) -> Any:
    """The LLVM intrinsic `name` for vectors of the type of `vector`."""
    suffix = {"float": "f32", "double": "f64"}[str(vector.type.element)]
    function_type = ir.FunctionType(vector.type, [vector.type])
    return cgutils.get_or_insert_function(builder.module, function_type, f"llvm.{name}.v{LANES}{suffix}")


_unary(operator.neg, lambda builder, a: builder.fneg(a))
_unary(operator.invert, lambda builder, a: builder.not_(a))
_unary(abs, lambda builder, a: builder.call(_llvm_intrinsic(builder, "fabs", a), [a]))


@intrinsic
def sqrt(typingctx: Any, a: Any) -> Any:
    """The square root of every lane, correctly rounded; NaN for negative numbers."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.call(_llvm_intrinsic(builder, "sqrt", args[0]), args)

    return a(a), lower


@intrinsic
def splat(typingctx: Any, value: Any) -> Any:
    """A vector with `value` in every lane; integers become int32."""
    element = types.int32 if isinstance(value, types.Integer) else types.unliteral(value)

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _broadcast(context, builder, args[0], sig.args[0], sig.return_type)

    return LanesType(element)(value), lower


@intrinsic
def select(typingctx: Any, mask: Any, a: Any, b: Any) -> Any:
    """Per lane, a where `mask` is set, else b. One of a and b may be a scalar. Both are always computed."""
    result = _common_vector(a, b)

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pair = (_broadcast(context, builder, v, t, result) for v, t in zip(args[1:], sig.args[1:], strict=True))
        return builder.select(args[0], *pair)

    return result(mask, a, b), lower


@intrinsic
def lane_numbers(typingctx: Any) -> Any:
    """The int32 numbers of the lanes, 0 to 7."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return ir.Constant(ir.VectorType(ir.IntType(32), LANES), list(range(LANES)))

    return LanesType(types.int32)(), lower


def _conversion(source: Any, target: Any) -> str:
    """The LLVM instruction, by its builder's name, that makes numbers of type `target` from those of type `source`."""
    if _is_float(source) and _is_float(target):
        return "fpext" if target.bitwidth > source.bitwidth else "fptrunc"
    if _is_float(target):
        return "sitofp" if _is_signed(source) else "uitofp"
    if target.bitwidth < source.bitwidth:
        return "trunc"
    return "sext" if _is_signed(source) else "zext"


@intrinsic
def convert(typingctx: Any, vector: Any, dtype: Any) -> Any:
    """A vector of whole numbers or reals as one of `dtype`; of reals as one of reals.

    Reals are rounded to the nearest; of whole numbers that do not fit, the low bits stay.
    """
    source, target = vector.element, dtype.instance_type
    if _is_float(source) and not _is_float(target):
        return None  # no kernel needs it, and how to round would have to be said

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        if source.bitwidth == target.bitwidth and _is_float(source) == _is_float(target):
            return args[0]
        return getattr(builder, _conversion(source, target))(
            args[0], ir.VectorType(context.get_data_type(target), LANES)
        )

    return LanesType(target)(vector, dtype), lower


@intrinsic
def view_bits(typingctx: Any, vector: Any, dtype: Any) -> Any:
    """The same bits of every lane, read as numbers of `dtype`, which has as many."""
    target = dtype.instance_type
    if target.bitwidth != vector.element.bitwidth:
        return None

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.bitcast(args[0], ir.VectorType(context.get_data_type(target), LANES))

    return LanesType(target)(vector, dtype), lower


def _select_ordered(builder: Any, symbol: str, a: Any, b: Any) -> Any:
    return builder.select(builder.fcmp_ordered(symbol, a, b), a, b)


@intrinsic
def minimum(typingctx: Any, a: Any, b: Any) -> Any:
    """Per lane, a if a < b, else b; so b where either is NaN."""
    return a(a, b), lambda context, builder, sig, args: _select_ordered(builder, "<", *args)


@intrinsic
def maximum(typingctx: Any, a: Any, b: Any) -> Any:
    """Per lane, a if a > b, else b; so b where either is NaN."""
    return a(a, b), lambda context, builder, sig, args: _select_ordered(builder, ">", *args)


@intrinsic
def extract_lane(typingctx: Any, vector: Any, i: Any) -> Any:
    """The number in lane i of a vector."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.extract_element(args[0], context.cast(builder, args[1], sig.args[1], types.int32))

    return vector.element(vector, i), lower


def _count_lanes(builder: Any, mask: Any, lanes: int) -> Any:
    return builder.zext(builder.ctpop(builder.bitcast(mask, ir.IntType(lanes))), ir.IntType(64))


@intrinsic
def count_lanes(typingctx: Any, mask: Any) -> Any:
    """In how many lanes a mask is set."""
    lanes = mask.lanes
    return types.intp(mask), lambda context, builder, sig, args: _count_lanes(builder, args[0], lanes)


@intrinsic
def any_lane(typingctx: Any, mask: Any) -> Any:
    """Whether a mask is set in any lane."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, bits.type(0))

    return types.boolean(mask), lower


def _pointer(context: Any, builder: Any, array: Any, value: Any, index: Any) -> Any:
    """The address of element `index` of the flattened array."""
    data = context.make_array(array)(context, builder, value).data
    return builder.gep(data, [index], inbounds=True)


def _vector_pointer(context: Any, builder: Any, array: Any, value: Any, element_index: Any, lanes: int) -> Any:
    """(pointer to a vector of `lanes` elements that begins at `element_index`, its alignment in bytes)."""
    pointer = _pointer(context, builder, array, value, element_index)
    item = context.get_data_type(array.dtype)
    return builder.bitcast(pointer, ir.VectorType(item, lanes).as_pointer()), array.dtype.bitwidth // 8


def _reads(lanes: int) -> Any:
    """The typing and lowering of a load of vectors of so many lanes."""

    def typed(typingctx: Any, array: Any, i: Any) -> Any:
        if array.layout != "C":
            return None

        def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            size = ir.Constant(ir.IntType(64), lanes)
            start = builder.mul(context.cast(builder, args[1], sig.args[1], types.intp), size)
            pointer, align = _vector_pointer(context, builder, sig.args[0], args[0], start, lanes)
            return builder.load(pointer, align=align)

        return LanesType(array.dtype, lanes)(array, i), lower

    return typed


def _writes(lanes: int) -> Any:
    """The typing and lowering of a store of vectors of so many lanes."""

    def typed(typingctx: Any, array: Any, i: Any, value: Any) -> Any:
        if array.layout != "C":
            return None

        def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            size = ir.Constant(ir.IntType(64), lanes)
            start = builder.mul(context.cast(builder, args[1], sig.args[1], types.intp), size)
            pointer, align = _vector_pointer(context, builder, sig.args[0], args[0], start, lanes)
            builder.store(args[2], pointer, align=align)
            return context.get_dummy_value()

        return types.void(array, i, value), lower

    return typed


@intrinsic
def load(typingctx: Any, array: Any, i: Any) -> Any:
    """Vector i of a C-contiguous array."""
    return _reads(LANES)(typingctx, array, i)


@intrinsic
def store(typingctx: Any, array: Any, i: Any, value: Any) -> Any:
    """Writes `value` to vector i of a C-contiguous array."""
    return _writes(LANES)(typingctx, array, i, value)


@intrinsic
def load_wide(typingctx: Any, array: Any, i: Any) -> Any:
    """Wide vector i of a C-contiguous array."""
    return _reads(WIDE)(typingctx, array, i)


@intrinsic
def store_wide(typingctx: Any, array: Any, i: Any, value: Any) -> Any:
    """Writes `value` to wide vector i of a C-contiguous array."""
    return _writes(WIDE)(typingctx, array, i, value)


@intrinsic
def store_numbers(typingctx: Any, array: Any, first: Any, mask: Any, number: Any) -> Any:
    """Writes `number` + i for every lane i that `mask` is set in, one after the other, from element `first` on.

    `array` is of int32. As many elements are written as there are lanes; those after the last number hold anything.

    Returns:
      How many numbers there are.
    """
    lanes = mask.lanes

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        start = context.cast(builder, args[1], sig.args[1], types.intp)
        pointer, align = _vector_pointer(context, builder, sig.args[0], args[0], start, lanes)
        vector = ir.VectorType(ir.IntType(32), lanes)
        base = _splat(builder, context.cast(builder, args[3], sig.args[3], types.int32), lanes)
        numbers = builder.add(base, ir.Constant(vector, list(range(lanes))))
        name = f"llvm.experimental.vector.compress.v{lanes}i32"
        function_type = ir.FunctionType(vector, [vector, args[2].type, vector])
        compress = cgutils.get_or_insert_function(builder.module, function_type, name)
        chosen = builder.call(compress, [numbers, args[2], ir.Constant(vector, ir.Undefined)])
        builder.store(chosen, pointer, align=align)
        return _count_lanes(builder, args[2], lanes)

    return types.intp(array, first, mask, number), lower


def _first_lanes(context: Any, builder: Any, count: Any, count_type: Any) -> Any:
    """A mask that is set in the first `count` lanes."""
    number = ir.Constant(ir.VectorType(ir.IntType(32), LANES), list(range(LANES)))
    return builder.icmp_signed("<", number, _splat(builder, context.cast(builder, count, count_type, types.int32)))


def _masked(builder: Any, name: str, result: Any, arguments: list[Any]) -> Any:
    """Calls the LLVM intrinsic `llvm.masked.<name>` for vectors; `arguments` as it takes them."""
    function_type = ir.FunctionType(result, [argument.type for argument in arguments])
    vector = result if name == "load" else arguments[0].type
    suffix = {"float": "f32", "double": "f64"}.get(str(vector.element), str(vector.element))
    full_name = f"llvm.masked.{name}.v{LANES}{suffix}.p0"
    return builder.call(cgutils.get_or_insert_function(builder.module, function_type, full_name), arguments)


@intrinsic
def load_some(typingctx: Any, array: Any, first: Any, count: Any) -> Any:
    """Elements `first` to `first + count - 1` of a C-contiguous array, at most eight, in the first lanes; else 0."""
    if array.layout != "C":
        return None

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        start = context.cast(builder, args[1], sig.args[1], types.intp)
        pointer, align = _vector_pointer(context, builder, sig.args[0], args[0], start, LANES)
        vector = ir.VectorType(context.get_data_type(sig.args[0].dtype), LANES)
        lanes = _first_lanes(context, builder, args[2], sig.args[2])
        arguments = [pointer, ir.Constant(ir.IntType(32), align), lanes, ir.Constant(vector, None)]
        return _masked(builder, "load", vector, arguments)

    return LanesType(array.dtype)(array, first, count), lower


@intrinsic
def store_some(typingctx: Any, array: Any, first: Any, count: Any, value: Any) -> Any:
    """Writes the first `count` lanes to elements `first` to `first + count - 1` of a C-contiguous array."""
    if array.layout != "C":
        return None

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        start = context.cast(builder, args[1], sig.args[1], types.intp)
        pointer, align = _vector_pointer(context, builder, sig.args[0], args[0], start, LANES)
        lanes = _first_lanes(context, builder, args[2], sig.args[2])
        _masked(builder, "store", ir.VoidType(), [args[3], pointer, ir.Constant(ir.IntType(32), align), lanes])
        return context.get_dummy_value()

    return types.void(array, first, count, value), lower


def _lane_indices(builder: Any, vector: Any) -> list[Any]:
    """The int32 indices in the lanes of `vector`, as eight scalars of 64 bits."""
    lanes = (builder.extract_element(vector, ir.Constant(ir.IntType(32), i)) for i in range(LANES))
    return [builder.sext(lane, ir.IntType(64)) for lane in lanes]


@intrinsic
def gather(typingctx: Any, array: Any, indices: Any) -> Any:
    """Per lane, the element of the flattened array at that lane's index (int32)."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        item = context.get_data_type(sig.args[0].dtype)
        result = ir.Constant(ir.VectorType(item, LANES), ir.Undefined)
        for i, index in enumerate(_lane_indices(builder, args[1])):
            value = builder.load(_pointer(context, builder, sig.args[0], args[0], index))
            result = builder.insert_element(result, value, ir.Constant(ir.IntType(32), i))
        return result

    return LanesType(array.dtype)(array, indices), lower


@intrinsic
def scatter(typingctx: Any, array: Any, indices: Any, value: Any) -> Any:
    """Per lane, writes the element of the flattened array at that lane's index (int32).

    Where lanes share an index, the last lane's value stays.
    """

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        for i, index in enumerate(_lane_indices(builder, args[1])):
            item = builder.extract_element(args[2], ir.Constant(ir.IntType(32), i))
            builder.store(item, _pointer(context, builder, sig.args[0], args[0], index))
        return context.get_dummy_value()

    return types.void(array, indices, value), lower


def _shuffle(builder: Any, a: Any, b: Any, order: list[int]) -> Any:
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), len(order)), order))


@intrinsic
def gather_4(typingctx: Any, array: Any, indices: Any) -> Any:
    """Per lane, the four columns of row `indices` (int32) of an array `[..., 4]`: four vectors, one per column.

    Eight loads of a row and a transpose of 8 x 4 (array of structures to structure of arrays). That is about three
    times faster than four gathers.
    """

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        rows = []
        for index in _lane_indices(builder, args[1]):
            start = builder.mul(index, ir.Constant(ir.IntType(64), 4))
            pointer, align = _vector_pointer(context, builder, sig.args[0], args[0], start, 4)
            rows.append(builder.load(pointer, align=align))
        # Rows i and i + 4 share a vector, so that every later shuffle stays within a 128-bit half of the register.
        wide = [_shuffle(builder, rows[i], rows[i + 4], list(range(8))) for i in range(4)]
        low = [0, 8, 1, 9, 4, 12, 5, 13]
        high = [2, 10, 3, 11, 6, 14, 7, 15]
        left, right = [0, 1, 8, 9, 4, 5, 12, 13], [2, 3, 10, 11, 6, 7, 14, 15]
        first, second = (_shuffle(builder, wide[i], wide[i + 1], low) for i in (0, 2))
        third, fourth = (_shuffle(builder, wide[i], wide[i + 1], high) for i in (0, 2))
        columns = [
            _shuffle(builder, first, second, left),
            _shuffle(builder, first, second, right),
            _shuffle(builder, third, fourth, left),
            _shuffle(builder, third, fourth, right),
        ]
        return context.make_tuple(builder, sig.return_type, columns)

    return types.UniTuple(LanesType(array.dtype), 4)(array, indices), lower
