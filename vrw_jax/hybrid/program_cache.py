"""One compiled program for functions that compute the same, such as the modes of a user.

Outside of `jax.jit` JAX compiles a loop again at each call if its body closes over functions, and
it keeps each program. Here functions are compared by their code and by the values that they refer
to. Equal functions share a program, whether or not they are the same object. A function with
another constant has another program.
"""

import dataclasses
import functools
import hashlib
import sys
import types
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from typing import Any

import jax
import numpy as np

from vrw_jax.numerics import is_inside_jit

MAX_PROGRAMS = 32
"""Largest number of programs that are kept, chosen because a program takes some 14 MB."""

MAX_HASHED_BYTES = 1_000_000
"""Largest size of a JAX array that is compared by content, chosen because a copy to the host and
its digest then take a millisecond. Larger arrays are compared by identity."""

FIXED_PACKAGES = frozenset({"jax", "jaxlib", "numpy", "vrw_jax"}) | sys.stdlib_module_names
"""Packages whose functions, classes and modules are compared by identity, chosen because users do
not change them while a process runs."""

_programs: OrderedDict[Hashable, Callable] = OrderedDict()


class _NoKeyError(Exception):
    """A function refers to an object that can change unnoticed, or to a traced value."""


@dataclasses.dataclass(frozen=True)
class _Identity:
    """Key of an object compared by identity. It holds the object, whose address stays in use."""

    content: Any

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Identity) and self.content is other.content

    def __hash__(self) -> int:
        return id(self.content)


def call_compiled(function: Callable, static: Any, *arguments: Any) -> Any:
    """Return `function(static, *arguments)`, from one compiled program for equal `static`.

    `static` is a tree of functions and constants. A function that refers to a traced value or to an
    object that can change unnoticed is compiled for this call alone. Inside `jax.jit` the function
    becomes part of the caller's program.
    """
    if is_inside_jit():
        return function(static, *arguments)
    program = find_program(function, static, *arguments)
    return (program or jax.jit(functools.partial(function, static)))(*arguments)


def find_program(function: Callable, static: Any, *arguments: Any) -> Callable | None:
    """Return the program for equal `static` and these arguments, or None if there can be none.

    The types of the arguments belong to the key. Each program is therefore traced once, while
    `static` has the values that the key was made from.
    """
    if is_inside_jit():
        return None
    leaves, structure = jax.tree.flatten(arguments)
    try:
        argument_types = structure, tuple(map(jax.typeof, leaves))
        key = (function, argument_types, _make_key(static, frozenset()))
    except _NoKeyError:
        return None
    if key not in _programs:
        _programs[key] = jax.jit(functools.partial(function, static))
    _programs.move_to_end(key)
    if len(_programs) > MAX_PROGRAMS:
        _programs.popitem(last=False)
    return _programs[key]


def _make_key(value: Any, enclosing_ids: frozenset) -> Hashable:
    """Return a key that is equal for two values only if both lead to the same program."""
    if isinstance(value, jax.core.Tracer) or id(value) in enclosing_ids:
        raise _NoKeyError
    make_inner_key = lambda x: _make_key(x, enclosing_ids | {id(value)})
    kind = type(value)
    if value is None or isinstance(value, str | bytes | bool | int | complex | types.CodeType):
        return kind, value
    if isinstance(value, float):
        return kind, value.hex()
    if isinstance(value, jax.Array) and value.nbytes <= MAX_HASHED_BYTES:
        return kind, value.weak_type, make_inner_key(np.asarray(value))
    if isinstance(value, np.ndarray | np.generic):
        if value.dtype == object:
            raise _NoKeyError
        return kind, value.shape, value.dtype.str, hashlib.sha256(value.tobytes()).digest()
    if isinstance(value, tuple | list):
        return kind, tuple(map(make_inner_key, value))
    if isinstance(value, dict):
        return kind, tuple((make_inner_key(k), make_inner_key(x)) for k, x in value.items())
    if isinstance(value, types.FunctionType):
        return kind, _make_function_key(value, enclosing_ids | {id(value)})
    if isinstance(value, type):
        return _make_class_key(value, enclosing_ids | {id(value)})
    if isinstance(value, types.ModuleType) and _is_fixed(value.__name__):
        return _Identity(value)
    if isinstance(value, functools.partial):
        parts = (value.func, value.args, value.keywords)
        return kind, tuple(map(make_inner_key, parts))
    if isinstance(value, types.MethodType):
        return kind, make_inner_key(value.__func__), make_inner_key(value.__self__)
    # A function with a rule, as from jax.custom_jvp, refers to what the user's function refers to.
    if hasattr(value, "__wrapped__") and not _is_fixed(value.__module__):
        return _Identity(value), make_inner_key(value.__wrapped__)
    fixed_kinds = (types.BuiltinFunctionType, jax.Array, np.ufunc, np.dtype)
    if isinstance(value, fixed_kinds) or kind.__module__.startswith(("jax", "numpy")):
        return _Identity(value)
    if dataclasses.is_dataclass(value):
        return make_inner_key(kind), make_inner_key(vars(value))
    raise _NoKeyError


def _is_fixed(module: str | None) -> bool:
    """Return whether a module, by its name, belongs to a package that users do not change."""
    return (module or "").split(".")[0] in FIXED_PACKAGES


def _make_class_key(kind: type, enclosing_ids: frozenset) -> Hashable:
    """Return a class, and the keys of its methods and constants if a user defines it."""
    if _is_fixed(kind.__module__):
        return _Identity(kind)
    attributes = {
        name: value
        for name, value in vars(kind).items()
        if not name.startswith("__") or name == "__call__"
    }
    return _Identity(kind), _make_key((attributes, kind.__bases__), enclosing_ids)


def _make_function_key(function: types.FunctionType, enclosing_ids: frozenset) -> Hashable:
    """Return the function's code, and the keys of all values that it refers to."""
    if _is_fixed(function.__module__) and not function.__closure__:
        return _Identity(function)
    names = {name for code in _iterate_codes(function.__code__) for name in code.co_names}
    global_keys = _make_scope_key(function.__globals__, names, enclosing_ids)
    try:
        cells = tuple(cell.cell_contents for cell in function.__closure__ or ())
    except ValueError:  # a cell that has no value yet
        raise _NoKeyError from None
    bound_values = (cells, function.__defaults__, function.__kwdefaults__)
    return function.__code__, global_keys, _make_key(bound_values, enclosing_ids)


def _make_scope_key(scope: dict, names: set[str], enclosing_ids: frozenset) -> Hashable:
    """Return the keys of the named objects of a scope; those of a module count by name, too."""

    def make_key(value: Any) -> Hashable:
        if not isinstance(value, types.ModuleType) or _is_fixed(value.__name__):
            return _make_key(value, enclosing_ids)
        if id(value) in enclosing_ids:
            return _Identity(value)
        return _Identity(value), _make_scope_key(vars(value), names, enclosing_ids | {id(value)})

    return tuple((name, make_key(scope[name])) for name in sorted(names) if name in scope)


def _iterate_codes(code: types.CodeType) -> Iterator[types.CodeType]:
    """Return the code and the codes of all functions that are defined inside it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _iterate_codes(constant)
