"""Default settings of JAX for this library, if the caller has set others."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax

Function = TypeVar("Function", bound=Callable[..., Any])


def with_default_settings(function: Function) -> Function:
    """Return `function` computed with the default settings of JAX, if the process has others.

    `jax_disable_jit` and strict promotion of ranks and dtypes help to find faults in the caller's
    own code. This library calls machine code from compiled programs only, and the same formulas
    serve numbers, batches and derivatives of any rank. The settings of the caller are restored when
    `function` returns.
    """

    @functools.wraps(function)
    def call_with_defaults(*args: Any, **keywords: Any) -> Any:
        if _has_default_settings():
            return function(*args, **keywords)
        with (
            jax.disable_jit(False),
            jax.numpy_rank_promotion("allow"),
            jax.numpy_dtype_promotion("standard"),
        ):
            return function(*args, **keywords)

    return call_with_defaults  # type: ignore[return-value]


def _has_default_settings() -> bool:
    """Return whether this thread has the default settings."""
    config: Any = jax.config
    return (
        not config.jax_disable_jit
        and config.jax_numpy_rank_promotion == "allow"
        and config.jax_numpy_dtype_promotion == "standard"
    )
