"""Parts of compiled code: memory by address, C calls, implementations of scene queries for one scene class.

Imported only where numba is installed.
"""

# numba is not typed, nor are its functions.
# pyright: basic, reportMissingTypeStubs=false, reportCallIssue=false

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, overload

from khep_twin.simulation.announcement import IMPLEMENTATIONS
from khep_twin.simulation.linking import INNER

_ADDRESS, _BYTE_POINTER = types.intp, ir.IntType(8).as_pointer()
_INT, _DOUBLE = ir.IntType(32), ir.DoubleType()


def implements(query: Callable[..., Any], scene_class: type | None = None) -> Callable[[Any], Any]:
    """Return a decorator for a function that implements a query in compiled code.

    Args:
        query: Function of `sensing.scene`, which asks a scene for a value or an action.
        scene_class: Class of scenes; None for all.
    """

    def register(function: Any) -> Any:
        def choose(scene, *rest):
            fits = scene_class is None or getattr(scene, "instance_class", None) is scene_class
            return function if fits else None

        IMPLEMENTATIONS.append(function)
        overload(query, strict=False, jit_options=INNER)(choose)
        return function

    return register


@intrinsic
def load(typing_context, address, index):
    """Return the float64 number at an address and an index."""

    def generate(context, builder, signature, arguments):
        return builder.load(_element_pointer(builder, arguments, _DOUBLE))

    return types.float64(_ADDRESS, types.intp), generate


@intrinsic
def load_int(typing_context, address, index):
    """Return the int32 number at an address and an index."""

    def generate(context, builder, signature, arguments):
        return builder.load(_element_pointer(builder, arguments, _INT))

    return types.int32(_ADDRESS, types.intp), generate


@intrinsic
def store(typing_context, address, index, value):
    """Set the float64 number at an address and an index."""

    def generate(context, builder, signature, arguments):
        builder.store(arguments[2], _element_pointer(builder, arguments, _DOUBLE))
        return context.get_dummy_value()

    return types.void(_ADDRESS, types.intp, types.float64), generate


@intrinsic
def address_of(typing_context, array):
    """Return the address of an array's first number."""

    def generate(context, builder, signature, arguments):
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        return builder.ptrtoint(data, ir.IntType(64))

    return _ADDRESS(array), generate


@intrinsic
def relocate(typing_context, values, addresses, row):
    """Return nested tuples whose arrays lie at the addresses in a row of a table (n, n_arrays) instead."""

    def generate(context, builder, signature, arguments):
        values_arg, table, row = arguments
        addresses = context.make_array(signature.args[1])(context, builder, table)
        n_arrays = builder.extract_value(addresses.shape, 1)
        element = [builder.mul(row, n_arrays)]

        def move(kind, value):
            if isinstance(kind, types.Array):
                array = context.make_array(kind)(context, builder, value)
                address = builder.load(builder.gep(addresses.data, [element[0]]))
                array.data = builder.inttoptr(address, array.data.type)
                element[0] = builder.add(element[0], ir.Constant(ir.IntType(64), 1))
                return array._getvalue()
            if isinstance(kind, types.BaseTuple):
                kinds: Any = kind
                parts = [move(part, builder.extract_value(value, i)) for i, part in enumerate(kinds)]
                return context.make_tuple(builder, kind, parts)
            return value

        return move(signature.args[0], values_arg)

    return values(values, addresses, types.intp), generate


@intrinsic
def call_update(typing_context, function, model, data):
    """Call a function of MuJoCo that updates the state, for example mj_step."""

    def generate(context, builder, signature, arguments):
        _emit_c_call(builder, arguments, [_BYTE_POINTER] * 2, ir.VoidType())
        return context.get_dummy_value()

    return types.void(*[_ADDRESS] * 3), generate


@intrinsic
def call_ray_geom(typing_context, function, position, rotation, size, start, direction, geom_type, normal):
    """Call mju_rayGeom; return the ray's length."""

    def generate(context, builder, signature, arguments):
        argument_types = [*[_BYTE_POINTER] * 5, _INT, _BYTE_POINTER]
        return _emit_c_call(builder, arguments, argument_types, _DOUBLE)

    return types.float64(*[_ADDRESS] * 8), generate


@intrinsic
def call_controller(typing_context, function, registers, memory, n_memory, genes, n_genes, speeds):
    """Call a compiled controller."""

    def generate(context, builder, signature, arguments):
        _emit_c_call(builder, arguments, [ir.IntType(64)] * 6, ir.VoidType())
        return context.get_dummy_value()

    return types.void(*[_ADDRESS] * 7), generate


def _element_pointer(builder, arguments, element_type):
    """Return the pointer to an element of the array at an address."""
    return builder.gep(builder.inttoptr(arguments[0], element_type.as_pointer()), [arguments[1]])


def _emit_c_call(builder, arguments, argument_types, return_type):
    """Call the function at the address in the first argument; the others are converted."""
    converted = []
    for value, kind in zip(arguments[1:], argument_types, strict=True):
        if isinstance(kind, ir.PointerType):
            value = builder.inttoptr(value, kind)
        elif isinstance(kind, ir.IntType) and kind.width < value.type.width:
            value = builder.trunc(value, kind)
        converted.append(value)
    function = builder.inttoptr(arguments[0], ir.FunctionType(return_type, argument_types).as_pointer())
    return builder.call(function, converted)
