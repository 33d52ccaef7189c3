"""Default settings of JAX for this library, for callers that have changed them."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax

FunctionType = TypeVar("FunctionType", bound=Callable[..., Any])


def with_default_jax_settings(function: FunctionType) -> FunctionType:
    """Return `function` computed with JAX's default settings, if the process has other settings.

    `jax_disable_jit` and strict promotion of ranks and dtypes help to find faults in the caller's
    code. But this library calls machine code from compiled programs only, and its formulas accept
    numbers, batches and derivatives of any rank. The settings of the caller are restored when
    `function` returns.
    """

    @functools.wraps(function)
    def call_with_default_settings(*args: Any, **keywords: Any) -> Any:
        jax_config: Any = jax.config
        is_jax_config_default = (
            not jax_config.jax_disable_jit
            and jax_config.jax_numpy_rank_promotion == "allow"
            and jax_config.jax_numpy_dtype_promotion == "standard"
        )
        if is_jax_config_default:
            return function(*args, **keywords)
        with (
            jax.disable_jit(False),
            jax.numpy_rank_promotion("allow"),
            jax.numpy_dtype_promotion("standard"),
        ):
            return function(*args, **keywords)

    return call_with_default_settings  # type: ignore[return-value]
