# SPDX-License-Identifier: Apache-2.0
"""Eight numbers at a time, for kernels: LLVM does not vectorise sums whose order it must keep, nor gathers from many arrays.

Inside a kernel `Float64x8` are eight float64 and calculate like one number, with numbers too; `Int64x8` are eight int64, `Boolx8` eight
truths. `Float32x16` are sixteen float32, `Int16x16` sixteen int16, which nothing keeps from overflowing. Each operation is one of LLVM's
on a vector, which becomes one or several instructions of whatever processor there is. A product and the sum it goes into may be
fused, as the processor can; NaN and infinities are what they are. Arrays that are read and written must be C-contiguous and are
addressed as flat ones; nothing checks bounds.
"""

import operator
from collections.abc import Callable
from functools import partial
from typing import Any

from llvmlite import ir  # type: ignore[import-untyped,unused-ignore]
from numba.core import cgutils, types
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

WIDTH, WIDE = 8, 16
_BOOL, _INT16, _INT32, _INT64 = ir.IntType(1), ir.IntType(16), ir.IntType(32), ir.IntType(64)
_DOUBLE, _SINGLE = ir.DoubleType(), ir.FloatType()


class SimdType(types.Type):  # type: ignore[misc,unused-ignore]
    """Eight numbers of one kind, as numba knows them."""

    def __init__(self, name: str, element: Any, width: int) -> None:
        super().__init__(name=name)
        self.vector = ir.VectorType(element, width)


class _VectorModel(models.PrimitiveModel):  # type: ignore[misc,unused-ignore]
    def __init__(self, manager: Any, numba_type: SimdType) -> None:
        super().__init__(manager, numba_type, numba_type.vector)


register_model(SimdType)(_VectorModel)
Float64x8, Int64x8, Boolx8 = (SimdType(*kind, WIDTH) for kind in (("Float64x8", _DOUBLE), ("Int64x8", _INT64), ("Boolx8", _BOOL)))
Float32x16, Int16x16 = SimdType("Float32x16", _SINGLE, WIDE), SimdType("Int16x16", _INT16, WIDE)
_SCALARS = {Float64x8: types.float64, Int64x8: types.int64, Boolx8: types.boolean, Float32x16: types.float32, Int16x16: types.int64}


def _vector(builder: Any, kind: SimdType, numba_type: Any, value: Any) -> Any:
    """A vector as it is, a number eight times."""
    if isinstance(numba_type, SimdType):
        return value
    if kind in (Boolx8, Int16x16):
        value = builder.trunc(value, kind.vector.element)
    nothing, count = ir.Constant(kind.vector, ir.Undefined), kind.vector.count
    first = builder.insert_element(nothing, value, _INT32(0))
    return builder.shuffle_vector(first, nothing, ir.Constant(ir.VectorType(_INT32, count), [0] * count))


def _operation(function: Any, kind: SimdType, result: SimdType, build: Callable[..., Any]) -> None:
    """Lets kernels apply a binary operator to vectors of a kind, and to one and a number."""
    pairs = ((kind, kind), (kind, _SCALARS[kind]), (_SCALARS[kind], kind))
    infer_global(function)(type("Cases", (ConcreteTemplate,), {"cases": [signature(result, *pair) for pair in pairs]}))

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        return build(builder, *(_vector(builder, kind, t, x) for t, x in zip(sig.args, arguments, strict=True)))

    for pair in pairs:
        lower_builtin(function, *pair)(lower)


def _arithmetic(builder: Any, a: Any, b: Any, instruction: str) -> Any:
    return getattr(builder, instruction)(a, b, **({"flags": ("contract",)} if instruction.startswith("f") else {}))


def _compared(builder: Any, a: Any, b: Any, sign: str) -> Any:
    return builder.fcmp_ordered(sign, a, b) if a.type.element == _DOUBLE else builder.icmp_signed(sign, a, b)


for _functions, _instructions in (
    ((operator.add, operator.iadd), ("fadd", "add")),
    ((operator.sub, operator.isub), ("fsub", "sub")),
    ((operator.mul, operator.imul), ("fmul", "mul")),
    ((operator.truediv,), ("fdiv", None)),
):
    for _function in _functions:
        for _kind, _instruction in zip((Float64x8, Int64x8, Float32x16, Int16x16), 2 * _instructions, strict=True):
            if _instruction is not None:
                _operation(_function, _kind, _kind, partial(_arithmetic, instruction=_instruction))
for _function, _sign in ((operator.lt, "<"), (operator.le, "<="), (operator.gt, ">"), (operator.ge, ">=")):
    for _kind in (Float64x8, Int64x8):
        _operation(_function, _kind, Boolx8, partial(_compared, sign=_sign))
_operation(operator.and_, Boolx8, Boolx8, lambda builder, a, b: builder.and_(a, b))
_operation(operator.xor, Boolx8, Boolx8, lambda builder, a, b: builder.xor(a, b))
infer_global(operator.neg)(type("Cases", (ConcreteTemplate,), {"cases": [signature(Float64x8, Float64x8)]}))


@lower_builtin(operator.neg, Float64x8)  # type: ignore[untyped-decorator,unused-ignore]
def _negative(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
    return builder.fneg(arguments[0])


def _kind_of(*numba_types: Any) -> SimdType:
    return next((t for t in numba_types if isinstance(t, SimdType)), Float64x8)


def _element(numba_type: Any) -> SimdType:
    """What eight of an array's elements are."""
    return Float64x8 if isinstance(numba_type.dtype, types.Float) else Int64x8


@intrinsic  # type: ignore[untyped-decorator,unused-ignore]
def splat(typing, number):  # type: ignore[no-untyped-def]
    """The number eight times; lanes as they are."""
    return Float64x8(number), lambda context, builder, sig, arguments: _vector(builder, Float64x8, sig.args[0], arguments[0])


@intrinsic  # type: ignore[untyped-decorator,unused-ignore]
def counting(typing, first):  # type: ignore[no-untyped-def]
    """Int64x8 first, first + 1, ..."""

    def build(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        return builder.add(_vector(builder, Int64x8, types.int64, arguments[0]), ir.Constant(Int64x8.vector, list(range(WIDTH))))

    return Int64x8(types.int64), build


@intrinsic  # type: ignore[untyped-decorator,unused-ignore]
def select(typing, condition, a, b):  # type: ignore[no-untyped-def]
    """Lane by lane a where the condition holds, else b; both are calculated."""
    kind = Int64x8 if Int64x8 in (a, b) or (isinstance(a, types.Integer) and isinstance(b, types.Integer)) else Float64x8
    a, b = (t if isinstance(t, SimdType) else _SCALARS[kind] for t in (a, b))

    def build(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        chosen = (_vector(builder, kind, t, x) for t, x in zip(sig.args[1:], arguments[1:], strict=True))
        return builder.select(arguments[0], *chosen)

    return kind(Boolx8, a, b), build


@intrinsic  # type: ignore[untyped-decorator,unused-ignore]
def square_root(typing, x):  # type: ignore[no-untyped-def]
    """Of each lane; NaN of a negative one."""

    def build(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        function_type = ir.FunctionType(Float64x8.vector, [Float64x8.vector])
        function = cgutils.get_or_insert_function(builder.module, function_type, f"llvm.sqrt.v{WIDTH}f64")
        return builder.call(function, arguments)

    return Float64x8(Float64x8), build


@intrinsic  # type: ignore[untyped-decorator,unused-ignore]
def total(typing, x):  # type: ignore[no-untyped-def]
    """The sum of the lanes, always in the same order."""

    def build(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        parts = [builder.extract_element(arguments[0], _INT32(k)) for k in range(WIDTH)]
        while len(parts) > 1:
            parts = [builder.fadd(a, b) for a, b in zip(parts[::2], parts[1::2], strict=True)]
        return parts[0]

    return types.float64(Float64x8), build


@intrinsic  # type: ignore[untyped-decorator,unused-ignore]
def total_f32(typing, x):  # type: ignore[no-untyped-def]
    """The sum of `Float32x16`, always in the same order."""

    def build(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        parts, left = arguments[0], WIDE
        while left > 1:  # the upper half onto the lower one
            left //= 2
            low, high = (ir.Constant(ir.VectorType(_INT32, left), list(range(k, k + left))) for k in (0, left))
            parts = builder.fadd(builder.shuffle_vector(parts, parts, low), builder.shuffle_vector(parts, parts, high))
        return builder.extract_element(parts, _INT32(0))

    return types.float32(Float32x16), build


@intrinsic  # type: ignore[untyped-decorator,unused-ignore]
def splat_i16(typing, number):  # type: ignore[no-untyped-def]
    """The number sixteen times."""
    return Int16x16(types.int64), lambda context, builder, sig, arguments: _vector(builder, Int16x16, types.int64, arguments[0])


@intrinsic  # type: ignore[untyped-decorator,unused-ignore]
def splat_f32(typing, number):  # type: ignore[no-untyped-def]
    """The number sixteen times."""
    return Float32x16(types.float32), lambda context, builder, sig, arguments: _vector(builder, Float32x16, types.float32, arguments[0])


@intrinsic  # type: ignore[untyped-decorator,unused-ignore]
def least(typing, x):  # type: ignore[no-untyped-def]
    """The smallest of `Int16x16`."""

    def build(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        function_type = ir.FunctionType(_INT16, [Int16x16.vector])
        function = cgutils.get_or_insert_function(builder.module, function_type, f"llvm.vector.reduce.smin.v{WIDE}i16")
        return builder.sext(builder.call(function, arguments), _INT64)

    return types.int64(Int16x16), build


@intrinsic  # type: ignore[untyped-decorator,unused-ignore]
def lesser(typing, a, b):  # type: ignore[no-untyped-def]
    """Lane by lane the smaller one of `Int16x16`, or of these and a number."""
    a, b = (t if t is Int16x16 else types.int64 for t in (a, b))

    def build(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        one, other = (_vector(builder, Int16x16, t, x) for t, x in zip(sig.args, arguments, strict=True))
        return builder.select(builder.icmp_signed("<", one, other), one, other)

    return Int16x16(a, b), build


@intrinsic  # type: ignore[untyped-decorator,unused-ignore]
def where_below(typing, a, limit, x, y):  # type: ignore[no-untyped-def]
    """Lane by lane x where a is below the limit, else y; `Int16x16`, or numbers."""
    arguments = tuple(t if t is Int16x16 else types.int64 for t in (a, limit, x, y))

    def build(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        one, other, yes, no = (_vector(builder, Int16x16, t, x) for t, x in zip(sig.args, arguments, strict=True))
        return builder.select(builder.icmp_signed("<", one, other), yes, no)

    return Int16x16(*arguments), build


@intrinsic  # type: ignore[untyped-decorator,unused-ignore]
def counting_i16(typing, first):  # type: ignore[no-untyped-def]
    """Int16x16 first, first + 1, ..."""

    def build(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        return builder.add(_vector(builder, Int16x16, types.int64, arguments[0]), ir.Constant(Int16x16.vector, list(range(WIDE))))

    return Int16x16(types.int64), build


@intrinsic  # type: ignore[untyped-decorator,unused-ignore]
def load_i16(typing, array, first):  # type: ignore[no-untyped-def]
    """Sixteen neighbouring numbers of an array of int16 or uint8."""

    def build(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        loaded = _loaded(context, builder, sig, arguments)
        return loaded if loaded.type == Int16x16.vector else builder.zext(loaded, Int16x16.vector)

    return Int16x16(array, types.int64), build


@intrinsic  # type: ignore[untyped-decorator,unused-ignore]
def load_f32(typing, array, first):  # type: ignore[no-untyped-def]
    """Sixteen neighbouring numbers of an array of float32 or uint8."""

    def build(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        loaded = _loaded(context, builder, sig, arguments)
        return loaded if loaded.type == Float32x16.vector else builder.uitofp(loaded, Float32x16.vector)

    return Float32x16(array, types.int64), build


def _loaded(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
    """Sixteen of whatever the array holds."""
    pointer = _address(context, builder, sig.args[0], *arguments)
    return builder.load(builder.bitcast(pointer, ir.VectorType(pointer.type.pointee, WIDE).as_pointer()), align=1)


@intrinsic  # type: ignore[untyped-decorator,unused-ignore]
def greatest(typing, x):  # type: ignore[no-untyped-def]
    """The largest of the lanes."""

    def build(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        out = builder.extract_element(arguments[0], _INT32(0))
        for k in range(1, WIDTH):
            other = builder.extract_element(arguments[0], _INT32(k))
            out = builder.select(builder.fcmp_ordered(">", other, out), other, out)
        return out

    return types.float64(Float64x8), build


@intrinsic  # type: ignore[untyped-decorator,unused-ignore]
def any_of(typing, condition):  # type: ignore[no-untyped-def]
    """Whether it holds in some lane."""

    def build(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        bits = builder.bitcast(arguments[0], ir.IntType(WIDTH))
        return builder.icmp_unsigned("!=", bits, ir.IntType(WIDTH)(0))

    return types.boolean(Boolx8), build


@intrinsic  # type: ignore[untyped-decorator,unused-ignore]
def transposed(typing, rows):  # type: ignore[no-untyped-def]
    """Of eight lanes the first numbers of all, the second numbers, and so on."""

    def build(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        rows = [builder.extract_value(arguments[0], k) for k in range(WIDTH)]
        for step in (1, 2, 4):
            lows = [k if not k & step else WIDTH + k - step for k in range(WIDTH)]
            low, high = (ir.Constant(ir.VectorType(_INT32, WIDTH), picks) for picks in (lows, [k + step for k in lows]))
            for i in range(WIDTH):
                if not i & step:
                    a, b = rows[i], rows[i + step]
                    rows[i], rows[i + step] = builder.shuffle_vector(a, b, low), builder.shuffle_vector(a, b, high)
        return context.make_tuple(builder, sig.return_type, rows)

    eight = types.UniTuple(Float64x8, WIDTH)  # type: ignore[attr-defined,unused-ignore]
    return eight(eight), build


def _address(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    return builder.gep(context.make_array(array_type)(context, builder, array).data, [index])


@intrinsic  # type: ignore[untyped-decorator,unused-ignore]
def load(typing, array, first):  # type: ignore[no-untyped-def]
    """Eight neighbouring numbers of an array."""

    def build(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        pointer = _address(context, builder, sig.args[0], *arguments)
        return builder.load(builder.bitcast(pointer, Float64x8.vector.as_pointer()), align=8)

    return Float64x8(array, types.int64), build


@intrinsic  # type: ignore[untyped-decorator,unused-ignore]
def store(typing, array, first, x):  # type: ignore[no-untyped-def]
    """Writes neighbouring numbers into an array of their kind."""

    def build(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        pointer = _address(context, builder, sig.args[0], *arguments[:2])
        vector = sig.args[2].vector
        builder.store(arguments[2], builder.bitcast(pointer, vector.as_pointer()), align=2 if vector == Int16x16.vector else 4)
        return context.get_dummy_value()

    return types.void(array, types.int64, x if x in (Int16x16, Float32x16) else Float64x8), build


@intrinsic  # type: ignore[untyped-decorator,unused-ignore]
def gather(typing, array, indices):  # type: ignore[no-untyped-def]
    """array[index] of each lane; of integers these are `Int64x8` again."""
    kind = _element(array)

    def build(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        out = ir.Constant(kind.vector, ir.Undefined)
        for k in range(WIDTH):
            index = builder.extract_element(arguments[1], _INT32(k))
            value = builder.load(_address(context, builder, sig.args[0], arguments[0], index))
            if kind is Int64x8 and value.type != _INT64:
                value = builder.sext(value, _INT64)
            out = builder.insert_element(out, value, _INT32(k))
        return out

    return kind(array, Int64x8), build


@intrinsic  # type: ignore[untyped-decorator,unused-ignore]
def scatter(typing, array, indices, x):  # type: ignore[no-untyped-def]
    """array[index] = x, lane after lane."""

    def build(context, builder, sig, arguments):  # type: ignore[no-untyped-def]
        for k in range(WIDTH):
            index, value = (builder.extract_element(a, _INT32(k)) for a in arguments[1:])
            builder.store(value, _address(context, builder, sig.args[0], arguments[0], index))
        return context.get_dummy_value()

    return types.void(array, Int64x8, Float64x8), build
