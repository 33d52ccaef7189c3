"""Programs that XLA compiles once for equal functions of users, such as fields and guards.

Outside of `jax.jit`, JAX compiles a loop again at each call if its body closes over functions. Here
functions with equal keys (see `keys`) share a program, even if they are different objects.
"""

import functools
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any

import jax

from vrw_jax.lanes.batching import is_inside_jit
from vrw_jax.lanes.keys import UnresolvableFunctionError, make_key

MAX_CACHED_PROGRAMS = 32
"""Largest number of programs in the cache, chosen because a program occupies about 14 MB."""

_program_by_key: OrderedDict[Hashable, Callable] = OrderedDict()


def call_compiled_program(function: Callable, static_arguments: Any, *arguments: Any) -> Any:
    """Return `function(static_arguments, *arguments)`, computed by a compiled program.

    `static_arguments` is a tree of functions and values. Calls with equal `static_arguments` share
    one program. A function without a key is compiled for this call alone. Inside `jax.jit` the
    function becomes part of the caller's program.
    """
    if is_inside_jit():
        return function(static_arguments, *arguments)
    compiled_program = get_compiled_program(function, static_arguments, *arguments)
    return (compiled_program or jax.jit(functools.partial(function, static_arguments)))(*arguments)


def get_compiled_program(
    function: Callable, static_arguments: Any, *arguments: Any
) -> Callable | None:
    """Return the compiled program for equal `static_arguments`, or None if they have no key.

    There is no key inside `jax.jit` either. The key contains the types of the arguments. Each
    program is therefore traced once, when `static_arguments` has the values of the key.
    """
    if is_inside_jit():
        return None
    argument_leaves, tree_structure = jax.tree.flatten(arguments)
    try:
        function_key = make_key(function, static_arguments)
    except UnresolvableFunctionError:
        return None
    program_key = (function_key, tree_structure, *map(jax.typeof, argument_leaves))
    if program_key not in _program_by_key:
        _program_by_key[program_key] = jax.jit(functools.partial(function, static_arguments))
    _program_by_key.move_to_end(program_key)
    if len(_program_by_key) > MAX_CACHED_PROGRAMS:
        _program_by_key.popitem(last=False)
    return _program_by_key[program_key]
