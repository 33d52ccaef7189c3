"""Cache of compiled programs, in which equal functions share one program, such as the modes of a
user.

Outside of `jax.jit` JAX compiles a loop again at each call if its body closes over functions, and
keeps each program. Here functions are compared by their code and by the values to which they refer.
Equal functions share a program, whether or not they are the same object. A function with another
constant has another program.
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
"""Largest size in bytes of a JAX array that is compared by content. It is chosen because a copy
to the host and its digest then take a millisecond. Larger arrays are compared by identity.
"""

FIXED_PACKAGES = frozenset({"jax", "jaxlib", "numpy", "vrw_jax"}) | sys.stdlib_module_names
"""Packages whose functions, classes and modules are compared by identity, chosen because users
do not change them while a process runs.
"""

_programs: OrderedDict[Hashable, Callable] = OrderedDict()


class _NoKeyError(Exception):
    """Error for a function that refers to a traced value, or to an object that can change
    unnoticed.
    """


@dataclasses.dataclass(frozen=True)
class _IdentityKey:
    """Key of an object that is compared by identity. The key contains the object, so its address
    stays in use.
    """

    content: Any

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _IdentityKey) and self.content is other.content

    def __hash__(self) -> int:
        return id(self.content)


def call_compiled(function: Callable, constants: Any, *arguments: Any) -> Any:
    """Return `function(constants, *arguments)`, computed by one compiled program for equal
    `constants`.

    `constants` is a tree of functions and values. A function that refers to a traced value or to an
    object that can change unnoticed is compiled for this call alone. Inside `jax.jit` the function
    becomes part of the caller's program.
    """
    if is_inside_jit():
        return function(constants, *arguments)
    program = find_program(function, constants, *arguments)
    return (program or jax.jit(functools.partial(function, constants)))(*arguments)


def find_program(function: Callable, constants: Any, *arguments: Any) -> Callable | None:
    """Return the compiled program for equal `constants` and arguments of these types, or None if no
    key exists.

    The types of the arguments belong to the key. Each program is therefore traced once, while
    `constants` has the values from which the key was made.
    """
    if is_inside_jit():
        return None
    leaves, structure = jax.tree.flatten(arguments)
    try:
        argument_types = structure, tuple(map(jax.typeof, leaves))
        key = (function, argument_types, _make_key(constants, frozenset()))
    except _NoKeyError:
        return None
    if key not in _programs:
        _programs[key] = jax.jit(functools.partial(function, constants))
    _programs.move_to_end(key)
    if len(_programs) > MAX_PROGRAMS:
        _programs.popitem(last=False)
    return _programs[key]


def _make_key(value: Any, enclosing_ids: frozenset) -> Hashable:
    """Return a key that is equal for two values only if both lead to the same program.

    `enclosing_ids` are the identities of the objects that contain the value; a reference to one of
    them raises an error.
    """
    if isinstance(value, jax.core.Tracer) or id(value) in enclosing_ids:
        raise _NoKeyError
    make_inner_key = lambda x: _make_key(x, enclosing_ids | {id(value)})
    value_type = type(value)
    if value is None or isinstance(value, str | bytes | bool | int | complex | types.CodeType):
        return value_type, value
    if isinstance(value, float):
        return value_type, value.hex()
    if isinstance(value, jax.Array) and value.nbytes <= MAX_HASHED_BYTES:
        return value_type, value.weak_type, make_inner_key(np.asarray(value))
    if isinstance(value, np.ndarray | np.generic):
        if value.dtype == object:
            raise _NoKeyError
        return value_type, value.shape, value.dtype.str, hashlib.sha256(value.tobytes()).digest()
    if isinstance(value, tuple | list):
        return value_type, tuple(map(make_inner_key, value))
    if isinstance(value, dict):
        return value_type, tuple(
            (make_inner_key(dict_key), make_inner_key(x)) for dict_key, x in value.items()
        )
    if isinstance(value, types.FunctionType):
        return value_type, _make_function_key(value, enclosing_ids | {id(value)})
    if isinstance(value, type):
        return _make_class_key(value, enclosing_ids | {id(value)})
    if isinstance(value, types.ModuleType) and _is_fixed(value.__name__):
        return _IdentityKey(value)
    if isinstance(value, functools.partial):
        partial_parts = (value.func, value.args, value.keywords)
        return value_type, tuple(map(make_inner_key, partial_parts))
    if isinstance(value, types.MethodType):
        return value_type, make_inner_key(value.__func__), make_inner_key(value.__self__)
    # A function with a derivative rule, as from jax.custom_jvp, refers to the values of the user's
    # function.
    if hasattr(value, "__wrapped__") and not _is_fixed(value.__module__):
        return _IdentityKey(value), make_inner_key(value.__wrapped__)
    fixed_types = (types.BuiltinFunctionType, jax.Array, np.ufunc, np.dtype)
    if isinstance(value, fixed_types) or value_type.__module__.startswith(("jax", "numpy")):
        return _IdentityKey(value)
    if dataclasses.is_dataclass(value):
        return make_inner_key(value_type), make_inner_key(vars(value))
    raise _NoKeyError


def _is_fixed(module: str | None) -> bool:
    """Return whether the module of this name belongs to a package that users do not change."""
    return (module or "").split(".")[0] in FIXED_PACKAGES


def _make_class_key(value_type: type, enclosing_ids: frozenset) -> Hashable:
    """Return the key of a class, with the keys of its methods and constants if a user defines
    it.
    """
    if _is_fixed(value_type.__module__):
        return _IdentityKey(value_type)
    attributes = {
        name: value
        for name, value in vars(value_type).items()
        if not name.startswith("__") or name == "__call__"
    }
    return _IdentityKey(value_type), _make_key((attributes, value_type.__bases__), enclosing_ids)


def _make_function_key(function: types.FunctionType, enclosing_ids: frozenset) -> Hashable:
    """Return the function's code, and the keys of all values to which it refers."""
    if _is_fixed(function.__module__) and not function.__closure__:
        return _IdentityKey(function)
    names = {name for code in _iterate_codes(function.__code__) for name in code.co_names}
    global_keys = _make_scope_key(function.__globals__, names, enclosing_ids)
    try:
        cell_values = tuple(cell.cell_contents for cell in function.__closure__ or ())
    except ValueError:  # A cell of the closure has no value yet.
        raise _NoKeyError from None
    bound_values = (cell_values, function.__defaults__, function.__kwdefaults__)
    return function.__code__, global_keys, _make_key(bound_values, enclosing_ids)


def _make_scope_key(scope: dict, names: set[str], enclosing_ids: frozenset) -> Hashable:
    """Return the names of a scope's objects and their keys; names of a module are followed into
    the module.
    """

    def make_entry_key(value: Any) -> Hashable:
        if not isinstance(value, types.ModuleType) or _is_fixed(value.__name__):
            return _make_key(value, enclosing_ids)
        if id(value) in enclosing_ids:
            return _IdentityKey(value)
        return _IdentityKey(value), _make_scope_key(vars(value), names, enclosing_ids | {id(value)})

    return tuple((name, make_entry_key(scope[name])) for name in sorted(names) if name in scope)


def _iterate_codes(code: types.CodeType) -> Iterator[types.CodeType]:
    """Return the code and the codes of all functions that are defined inside it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _iterate_codes(constant)
