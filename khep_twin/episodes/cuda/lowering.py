"""The functions of `views` for a GPU, and the queries of a plane's scene, as numba-cuda compiles them.

Imported only where numba-cuda is installed, and not for its simulator.
"""

# numba-cuda is not typed, and its functions have no types of their own.
# pyright: basic, reportMissingImports=false, reportMissingTypeStubs=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false

import math
import operator

from llvmlite import ir
from numba import literal_unroll
from numba.cuda import types
from numba.cuda.cudadecl import registry as declarations
from numba.cuda.cudaimpl import registry as implementations
from numba.cuda.extending import core_models, intrinsic, overload, register_jitable, register_model
from numba.cuda.typing.templates import AttributeTemplate

from khep_twin.compilable import FUNCTIONS, unroll
from khep_twin.episodes import fitness, stepping
from khep_twin.episodes.cuda import views
from khep_twin.episodes.planar import casting
from khep_twin.robots.core import DUTIES, core_of_fields
from khep_twin.sensing import scene as queries

_OVERLOADED = fitness.square_root, fitness.clip
"""Functions of numbers and arrays; a GPU calls them with numbers only."""


class _Overlay(types.Type):
    """Type of a `views.overlay`: a record or another overlay, and the values of some of its fields."""

    def __init__(self, record, override):
        self.record, self.override = record, override
        self.names = tuple(override.fields)  # of a record or of a named tuple
        super().__init__(f"Overlay({record}, {override})")


class _Obstacles(types.Type):
    """Type of a `views.obstacles_at`."""

    def __init__(self, fixed, state):
        self.fixed, self.state = fixed, state
        super().__init__(f"Obstacles({fixed}, {state})")


@register_model(_Overlay)
class _OverlayModel(core_models.StructModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, [("record", kind.record), ("override", kind.override)])


@register_model(_Obstacles)
class _ObstaclesModel(core_models.StructModel):
    def __init__(self, manager, kind):
        members = [("fixed", kind.fixed), ("state", kind.state), ("n_fixed", types.intp)]
        super().__init__(manager, kind, members)


@declarations.register_attr
class _OverlayAttributes(AttributeTemplate):
    key = _Overlay

    def generic_resolve(self, kind, name):
        return self.context.resolve_getattr(kind.override if name in kind.names else kind.record, name)


@declarations.register_attr
class _ObstaclesAttributes(AttributeTemplate):
    key = _Obstacles

    def generic_resolve(self, kind, name):
        return {"fixed": kind.fixed, "state": kind.state, "n_fixed": types.intp}.get(name)


@implementations.lower_getattr_generic(_Overlay)
def _overlay_field(context, builder, kind, value, name):
    index, member = (1, kind.override) if name in kind.names else (0, kind.record)
    member_value = builder.extract_value(value, index)
    return context.get_getattr(member, name)(context, builder, member, member_value, name)


@implementations.lower_getattr_generic(_Obstacles)
def _obstacles_member(context, builder, kind, value, name):
    return builder.extract_value(value, ("fixed", "state", "n_fixed").index(name))


def _pack_values(context, builder, signature, arguments):
    """Return a struct of the arguments."""
    struct = ir.Constant(context.get_value_type(signature.return_type), ir.Undefined)
    for index, argument in enumerate(arguments):
        struct = builder.insert_value(struct, argument, index)
    return struct


@intrinsic
def _overlay(typing_context, record, override):
    """Return an overlay."""
    return _Overlay(record, override)(record, override), _pack_values


@intrinsic
def _obstacles_at(typing_context, fixed, state, n_fixed):
    """Return a table of obstacles."""
    return _Obstacles(fixed, state)(fixed, state, types.intp), _pack_values


@intrinsic
def _array_at(typing_context, local, offset, template):
    """Return an array of a template's shape and type, at a word of local memory."""

    def generate(context, builder, signature, arguments):
        array = context.make_array(template)(context, builder, arguments[2])
        array.data = _pointer_at(context, builder, signature, arguments, array.data.type)
        return array._getvalue()

    return template(local, types.intp, template), generate


@intrinsic
def _record_at(typing_context, local, offset, template):
    """Return a record of a template's type, at a word of local memory."""

    def generate(context, builder, signature, arguments):
        return _pointer_at(context, builder, signature, arguments, context.get_value_type(template.dtype))

    return template.dtype(local, types.intp, template), generate


def _pointer_at(context, builder, signature, arguments, pointer_type):
    """Return the pointer to a word of local memory."""
    words = context.make_array(signature.args[0])(context, builder, arguments[0]).data
    return builder.bitcast(builder.gep(words, [arguments[1]]), pointer_type)


def _fixed_chooser(function):
    """Return a function that selects an implementation for arguments of any kind."""

    def choose(*arguments):
        return function

    return choose


def _duty_chooser(duty):
    """Return a function that selects a duty's function for the state of a robot, an overlay."""

    def choose(robot, *rest):
        while isinstance(robot, _Overlay):
            robot = robot.record
        core = core_of_fields(getattr(robot, "fields", ()))
        return core and getattr(core, duty)

    return choose


def _keep_outputs(function, registers, memory, genes, outputs):
    """Leave the outputs unchanged: functions are not supported on a GPU."""


for _plain in FUNCTIONS:
    if _plain not in _OVERLOADED:
        register_jitable(_plain)
register_jitable(views.state_word)
for _query in casting.QUERIES:
    overload(getattr(queries, _query.__name__), strict=False)(_fixed_chooser(_query))
for _duty in DUTIES:
    overload(_duty, strict=False)(_duty_chooser(_duty.__name__))
for _query, _function in (
    (views.overlay, lambda record, override: _overlay(record, override)),
    (views.obstacles_at, lambda fixed, state, n_fixed: _obstacles_at(fixed, state, n_fixed)),
    (views.array_at, lambda local, offset, template: _array_at(local, offset, template)),
    (views.record_at, lambda local, offset, template: _record_at(local, offset, template)),
    (views.constant_of, lambda table, slot: table[min(slot, len(table) - 1)]),
    (views.scene_of, lambda plane: plane),
    (stepping.call_function, _keep_outputs),
    (unroll, lambda groups: groups),
    (literal_unroll, lambda groups: groups),  # what `unroll` is after compilations
    (fitness.square_root, lambda number: math.sqrt(number)),
    (fitness.clip, lambda number, low, high: min(max(number, low), high)),
):
    overload(_query, strict=False, inline="always")(_fixed_chooser(_function))  # an array cannot be returned


@overload(len)
def _length(table):
    if isinstance(table, _Obstacles):
        return lambda table: len(table.fixed)


@overload(operator.getitem)
def _get(table, index):
    if isinstance(index, types.IntEnumMember):
        return lambda table, index: table[index.value]
    if isinstance(table, _Obstacles):

        def get(table, index):
            obstacle, column = index
            word = views.state_word(obstacle, column, table.n_fixed)
            return table.fixed[obstacle, column] if word < 0 else table.state[word]

        return get


@overload(operator.setitem)
def _set(table, index, value):
    if isinstance(index, types.IntEnumMember):
        return lambda table, index, value: operator.setitem(table, index.value, value)
    if isinstance(table, _Obstacles):

        def set_value(table, index, value):
            obstacle, column = index
            table.state[views.state_word(obstacle, column, table.n_fixed)] = value

        return set_value
