"""Check types and shapes of arguments and results in the first call of each function in a test.

A test calls some functions many thousand times, mostly while JAX traces. A check of every call
takes a third of the time of such tests. A wrong shape in a later call of a test is not found.

A function that is defined inside another one is checked in its first call in the process, because
Python defines it anew in each call of the outer function, and beartype would write new code for it.
"""

import dataclasses
import functools
import inspect
from collections.abc import Callable
from types import CodeType
from typing import Any

import jaxtyping

FunctionOrClass = Any
"""A function, or a class whose `__init__` is a function."""

_check_every_call = jaxtyping.jaxtyped
_checked_in_test: set[CodeType] = set()
"""Code of functions that the present test has called."""
_checked_in_process: set[CodeType] = set()
"""Code of functions inside other functions that this process has called."""


def start_test() -> None:
    """Let the next call of each function be checked, except functions inside other functions."""
    _checked_in_test.clear()


def check_first_calls(
    *, typechecker: Callable[[FunctionOrClass], FunctionOrClass]
) -> Callable[[FunctionOrClass], FunctionOrClass]:
    """Return a decorator that replaces `jaxtyping.jaxtyped` and checks one call per test."""

    def decorate(target: FunctionOrClass) -> FunctionOrClass:
        if inspect.isclass(target):
            if dataclasses.is_dataclass(target) and "__init__" in vars(target):
                target.__init__ = decorate(target.__init__)
            return target
        code = target.__code__
        checked_code = (
            _checked_in_process if "<locals>" in target.__qualname__ else _checked_in_test
        )
        get_checked = functools.cache(lambda: _check_every_call(target, typechecker=typechecker))

        @functools.wraps(target)
        def call(*args: object, **kwargs: object) -> object:
            if code in checked_code:
                return target(*args, **kwargs)
            checked_code.add(code)
            return get_checked()(*args, **kwargs)

        return call

    return decorate


def import_with_checks(packages: list[str]) -> None:
    """Import `vrw_jax` so that its functions check their signatures."""
    # Functions inside others are decorated when these run.
    jaxtyping.jaxtyped = check_first_calls
    with jaxtyping.install_import_hook(packages, "beartype.beartype"):
        from vrw_jax.lanes import keys

    # What a checked function computes is what the function itself computes.
    def compute_nothing() -> None: ...

    for decorate in (check_first_calls, _check_every_call):
        checked = decorate(typechecker=lambda target: target)(compute_nothing)
        keys.transparent_wrapper_codes.add(checked.__code__)
