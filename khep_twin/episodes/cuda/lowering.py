"""The functions of `views` for a card, and the queries of a plane's scene, as numba compiles them.

Imported only where numba-cuda is installed, and not for its simulator.
"""

# numba-cuda is not typed, and its functions have no types of their own.
# pyright: basic, reportMissingImports=false, reportMissingTypeStubs=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false

import math
import operator

from llvmlite import ir
from numba.cuda import types
from numba.cuda.cudadecl import registry as declarations
from numba.cuda.cudaimpl import registry as implementations
from numba.cuda.extending import core_models, intrinsic, overload, register_jitable, register_model
from numba.cuda.typing.templates import AttributeTemplate

from khep_twin.compilable import FUNCTIONS
from khep_twin.episodes import fitness
from khep_twin.episodes.cuda import views
from khep_twin.episodes.planar import casting
from khep_twin.sensing import scene as queries

_OVERLOADED = fitness.root, fitness.clipped
"""Functions of numbers and arrays; a card has numbers."""


class _Split(types.Type):
    """Type of a `views.split`: a record or another split, and what has some of its fields."""

    def __init__(self, record, over):
        self.record, self.over = record, over
        self.names = tuple(over.fields)  # of a record or of a named tuple
        super().__init__(f"Split({record}, {over})")


class _Things(types.Type):
    """Type of a `views.things_at`."""

    def __init__(self, fixed, own):
        self.fixed, self.own = fixed, own
        super().__init__(f"Things({fixed}, {own})")


@register_model(_Split)
class _SplitModel(core_models.StructModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, [("record", kind.record), ("over", kind.over)])


@register_model(_Things)
class _ThingsModel(core_models.StructModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, [("fixed", kind.fixed), ("own", kind.own), ("n_fixed", types.intp)])


@declarations.register_attr
class _SplitAttributes(AttributeTemplate):
    key = _Split

    def generic_resolve(self, kind, name):
        return self.context.resolve_getattr(kind.over if name in kind.names else kind.record, name)


@declarations.register_attr
class _ThingsAttributes(AttributeTemplate):
    key = _Things

    def generic_resolve(self, kind, name):
        return {"fixed": kind.fixed, "own": kind.own, "n_fixed": types.intp}.get(name)


@implementations.lower_getattr_generic(_Split)
def _field(context, builder, kind, value, name):
    place, part = (1, kind.over) if name in kind.names else (0, kind.record)
    return context.get_getattr(part, name)(context, builder, part, builder.extract_value(value, place), name)


@implementations.lower_getattr_generic(_Things)
def _part(context, builder, kind, value, name):
    return builder.extract_value(value, ("fixed", "own", "n_fixed").index(name))


def _gathered(context, builder, signature, arguments):
    """Return a value that consists of the arguments."""
    made = ir.Constant(context.get_value_type(signature.return_type), ir.Undefined)
    for place, argument in enumerate(arguments):
        made = builder.insert_value(made, argument, place)
    return made


@intrinsic
def _split(typing_context, record, over):
    """Return a split."""
    return _Split(record, over)(record, over), _gathered


@intrinsic
def _things_at(typing_context, fixed, own, n_fixed):
    """Return things."""
    return _Things(fixed, own)(fixed, own, types.intp), _gathered


@intrinsic
def _array_at(typing_context, local, first, like):
    """Return an array as another one, at a word of local memory."""

    def generate(context, builder, signature, arguments):
        array = context.make_array(like)(context, builder, arguments[2])
        array.data = _place(context, builder, signature, arguments, array.data.type)
        return array._getvalue()

    return like(local, types.intp, like), generate


@intrinsic
def _record_at(typing_context, local, first, like):
    """Return a record as those of an array, at a word of local memory."""

    def generate(context, builder, signature, arguments):
        return _place(context, builder, signature, arguments, context.get_value_type(like.dtype))

    return like.dtype(local, types.intp, like), generate


def _place(context, builder, signature, arguments, kind):
    """Return the pointer to a word of local memory."""
    words = context.make_array(signature.args[0])(context, builder, arguments[0]).data
    return builder.bitcast(builder.gep(words, [arguments[1]]), kind)


def _always(function):
    """Return what chooses a function for arguments of any kind."""

    def choose(*arguments):
        return function

    return choose


def _nothing(function, registers, memory, genes, speeds):
    """Leave the speeds: functions are refused on a card."""


for _plain in FUNCTIONS:
    if _plain not in _OVERLOADED:
        register_jitable(_plain)
register_jitable(views.own_word)
for _query in casting.QUERIES:
    overload(getattr(queries, _query.__name__), strict=False)(_always(_query))
for _query, _function in (
    (views.split, lambda record, over: _split(record, over)),
    (views.things_at, lambda fixed, own, n_fixed: _things_at(fixed, own, n_fixed)),
    (views.array_at, lambda local, first, like: _array_at(local, first, like)),
    (views.record_at, lambda local, first, like: _record_at(local, first, like)),
    (views.row_of, lambda rows, lane: rows[min(lane, len(rows) - 1)]),
    (views.scene_of, lambda plane: plane),
    (queries.decide, _nothing),
    (fitness.root, lambda number: math.sqrt(number)),
    (fitness.clipped, lambda number, low, high: min(max(number, low), high)),
):
    overload(_query, strict=False, inline="always")(_always(_function))  # an array cannot be returned


@overload(len)
def _length(things):
    if isinstance(things, _Things):
        return lambda things: len(things.fixed)


@overload(operator.getitem)
def _get(things, at):
    if isinstance(things, _Things):

        def get(things, at):
            thing, column = at
            word = views.own_word(thing, column, things.n_fixed)
            return things.fixed[thing, column] if word < 0 else things.own[word]

        return get


@overload(operator.setitem)
def _set(things, at, value):
    if isinstance(things, _Things):

        def put(things, at, value):
            thing, column = at
            things.own[views.own_word(thing, column, things.n_fixed)] = value

        return put
