"""Cache of compiled programs, in which equal functions share one program.

The cache serves functions of users, such as the vector fields and guards of modes. Outside of
`jax.jit`, JAX compiles a loop again at each call if its body closes over functions, and stores each
program. The cache compares functions by their code and by the values to which they refer. Equal
functions share a program, even if they are different objects. Functions with different constants
have different programs.
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

MAX_CACHED_PROGRAMS = 32
"""Largest number of programs in the cache.

The value is chosen because a program occupies about 14 MB.
"""

MAX_HASHED_ARRAY_BYTES = 1_000_000
"""Largest size in bytes of a JAX array that the cache compares by content.

Larger arrays are compared by identity. The value is chosen because a copy to the host and its
digest then take a millisecond.
"""

UNCHANGING_PACKAGES = frozenset({"jax", "jaxlib", "numpy", "vrw_jax"}) | sys.stdlib_module_names
"""Packages whose functions, classes and modules are compared by identity.

They are chosen because users do not change them while a process runs.
"""

_program_by_key: OrderedDict[Hashable, Callable] = OrderedDict()


class _UncacheableFunctionError(Exception):
    """Error for a function without a key.

    Such a function refers to a traced value or to an object that can change unnoticed.
    """


@dataclasses.dataclass(frozen=True)
class _IdentityKey:
    """Key for an object that the cache compares by identity.

    The key contains the object, so that its address is not reused.
    """

    identified_object: Any

    def __eq__(self, other_key: object) -> bool:
        return (
            isinstance(other_key, _IdentityKey)
            and self.identified_object is other_key.identified_object
        )

    def __hash__(self) -> int:
        return id(self.identified_object)


def call_compiled_program(function: Callable, static_arguments: Any, *arguments: Any) -> Any:
    """Return `function(static_arguments, *arguments)`, computed by a compiled program.

    `static_arguments` is a tree of functions and values. Calls with equal `static_arguments` share
    one program. A function that refers to a traced value or to an object that can change unnoticed
    is compiled for this call alone. Inside `jax.jit` the function becomes part of the caller's
    program.
    """
    if is_inside_jit():
        return function(static_arguments, *arguments)
    compiled_program = get_compiled_program(function, static_arguments, *arguments)
    return (compiled_program or jax.jit(functools.partial(function, static_arguments)))(*arguments)


def get_compiled_program(
    function: Callable, static_arguments: Any, *arguments: Any
) -> Callable | None:
    """Return the compiled program for equal `static_arguments`, or None if they have no key.

    No key exists inside `jax.jit`, or if `static_arguments` refers to a traced value or to an
    object that can change unnoticed. The key contains the types of the arguments. Each program is
    therefore traced once, when `static_arguments` has the values from which the key is made.
    """
    if is_inside_jit():
        return None
    argument_leaves, tree_structure = jax.tree.flatten(arguments)
    try:
        argument_type_keys = tree_structure, tuple(map(jax.typeof, argument_leaves))
        program_key = (function, argument_type_keys, _make_cache_key(static_arguments, frozenset()))
    except _UncacheableFunctionError:
        return None
    if program_key not in _program_by_key:
        _program_by_key[program_key] = jax.jit(functools.partial(function, static_arguments))
    _program_by_key.move_to_end(program_key)
    if len(_program_by_key) > MAX_CACHED_PROGRAMS:
        _program_by_key.popitem(last=False)
    return _program_by_key[program_key]


def _make_cache_key(keyed_value: Any, ids_of_enclosing_objects: frozenset) -> Hashable:
    """Return a hashable key for a value. Values with equal keys lead to the same program.

    - `ids_of_enclosing_objects`: identities of the objects that contain the value. A reference to
      one of these objects raises `_UncacheableFunctionError`.
    """
    if isinstance(keyed_value, jax.core.Tracer) or id(keyed_value) in ids_of_enclosing_objects:
        raise _UncacheableFunctionError
    make_inner_key = lambda x: _make_cache_key(x, ids_of_enclosing_objects | {id(keyed_value)})
    value_type = type(keyed_value)
    if keyed_value is None or isinstance(
        keyed_value, str | bytes | bool | int | complex | types.CodeType
    ):
        return value_type, keyed_value
    if isinstance(keyed_value, float):
        return value_type, keyed_value.hex()
    if isinstance(keyed_value, jax.Array) and keyed_value.nbytes <= MAX_HASHED_ARRAY_BYTES:
        return value_type, keyed_value.weak_type, make_inner_key(np.asarray(keyed_value))
    if isinstance(keyed_value, np.ndarray | np.generic):
        if keyed_value.dtype == object:
            raise _UncacheableFunctionError
        return (
            value_type,
            keyed_value.shape,
            keyed_value.dtype.str,
            hashlib.sha256(keyed_value.tobytes()).digest(),
        )
    if isinstance(keyed_value, tuple | list):
        return value_type, tuple(map(make_inner_key, keyed_value))
    if isinstance(keyed_value, dict):
        return value_type, make_inner_key(tuple(keyed_value.items()))
    if isinstance(keyed_value, types.FunctionType):
        return value_type, _make_function_key(
            keyed_value, ids_of_enclosing_objects | {id(keyed_value)}
        )
    if isinstance(keyed_value, type):  # The key for a user's class has its methods and constants.
        if _is_in_unchanging_package(keyed_value.__module__):
            return _IdentityKey(keyed_value)
        class_attributes = {
            attribute_name: class_attribute
            for attribute_name, class_attribute in vars(keyed_value).items()
            if not attribute_name.startswith("__") or attribute_name == "__call__"
        }
        return _IdentityKey(keyed_value), make_inner_key((class_attributes, keyed_value.__bases__))
    if isinstance(keyed_value, types.ModuleType) and _is_in_unchanging_package(
        keyed_value.__name__
    ):
        return _IdentityKey(keyed_value)
    if isinstance(keyed_value, functools.partial):
        return value_type, make_inner_key(
            (keyed_value.func, keyed_value.args, keyed_value.keywords)
        )
    if isinstance(keyed_value, types.MethodType):
        return value_type, make_inner_key((keyed_value.__func__, keyed_value.__self__))
    # A function with a derivative rule, as from jax.custom_jvp, refers to the values of the user's
    # function.
    if hasattr(keyed_value, "__wrapped__") and not _is_in_unchanging_package(
        keyed_value.__module__
    ):
        return _IdentityKey(keyed_value), make_inner_key(keyed_value.__wrapped__)
    immutable_types = (types.BuiltinFunctionType, jax.Array, np.ufunc, np.dtype)
    if isinstance(keyed_value, immutable_types) or value_type.__module__.startswith(
        ("jax", "numpy")
    ):
        return _IdentityKey(keyed_value)
    if dataclasses.is_dataclass(keyed_value):
        return make_inner_key(value_type), make_inner_key(vars(keyed_value))
    raise _UncacheableFunctionError


def _is_in_unchanging_package(module_name: str | None) -> bool:
    """Return whether `module_name` is a module of a package in `UNCHANGING_PACKAGES`."""
    return (module_name or "").split(".")[0] in UNCHANGING_PACKAGES


def _make_function_key(
    function: types.FunctionType, ids_of_enclosing_objects: frozenset
) -> Hashable:
    """Return the key for a function: its code, and the keys for all values to which it refers."""
    if _is_in_unchanging_package(function.__module__) and not function.__closure__:
        return _IdentityKey(function)
    global_names = {
        global_name
        for code_object in _iterate_code_objects(function.__code__)
        for global_name in code_object.co_names
    }
    global_keys = _make_scope_key(function.__globals__, global_names, ids_of_enclosing_objects)
    try:
        cell_values = tuple(
            closure_cell.cell_contents for closure_cell in function.__closure__ or ()
        )
    except ValueError:  # A cell of the closure has no value yet.
        raise _UncacheableFunctionError from None
    bound_argument_values = (cell_values, function.__defaults__, function.__kwdefaults__)
    return (
        function.__code__,
        global_keys,
        _make_cache_key(bound_argument_values, ids_of_enclosing_objects),
    )


def _make_scope_key(
    objects_by_name: dict, object_names: set[str], ids_of_enclosing_objects: frozenset
) -> Hashable:
    """Return pairs of name and key for those `object_names` that occur in `objects_by_name`.

    The key for a user's module contains the module's objects with these names.
    """

    def make_entry_key(entry_value: Any) -> Hashable:
        if not isinstance(entry_value, types.ModuleType) or _is_in_unchanging_package(
            entry_value.__name__
        ):
            return _make_cache_key(entry_value, ids_of_enclosing_objects)
        if id(entry_value) in ids_of_enclosing_objects:
            return _IdentityKey(entry_value)
        return _IdentityKey(entry_value), _make_scope_key(
            vars(entry_value), object_names, ids_of_enclosing_objects | {id(entry_value)}
        )

    return tuple(
        (object_name, make_entry_key(objects_by_name[object_name]))
        for object_name in sorted(object_names)
        if object_name in objects_by_name
    )


def _iterate_code_objects(code_object: types.CodeType) -> Iterator[types.CodeType]:
    """Yield a code object and the code objects of all functions that are defined inside it."""
    yield code_object
    for code_constant in code_object.co_consts:
        if isinstance(code_constant, types.CodeType):
            yield from _iterate_code_objects(code_constant)
