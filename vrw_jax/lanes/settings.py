"""JAX settings that this library needs, for callers who have changed the default settings."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax

FunctionType = TypeVar("FunctionType", bound=Callable[..., Any])

FUSION_EMITTERS_FLAG = "xla_cpu_use_fusion_emitters"
"""Flag of XLA that switches its fusion emitters for CPUs."""


def with_default_jax_settings(function: FunctionType) -> FunctionType:
    """Return a function that runs `function` with JAX's default settings.

    `jax_disable_jit` and strict promotion of ranks and dtypes help to find faults in the caller's
    code. But only compiled programs can call this library's machine code, and its formulas accept
    numbers, batches and derivatives of any rank. The caller's settings are restored when `function`
    returns.
    """

    @functools.wraps(function)
    def call_with_default_settings(*args: Any, **keywords: Any) -> Any:
        jax_config: Any = jax.config
        has_default_jax_settings = (
            not jax_config.jax_disable_jit
            and jax_config.jax_numpy_rank_promotion == "allow"
            and jax_config.jax_numpy_dtype_promotion == "standard"
        )
        try:
            if has_default_jax_settings:
                return function(*args, **keywords)
            with (
                jax.disable_jit(False),
                jax.numpy_rank_promotion("allow"),
                jax.numpy_dtype_promotion("standard"),
            ):
                return function(*args, **keywords)
        except KeyboardInterrupt as interruption:
            if not interruption.args:
                raise
            # The frames of the library would hide a message that states what is kept.
            raise interruption.with_traceback(None) from None

    return call_with_default_settings  # type: ignore[return-value]


def make_fusion_emitter_options(are_fusion_emitters_enabled: bool) -> dict[str, str | bool]:
    """Return options for `jax.jit` that switch XLA's fusion emitters on or off on a CPU.

    Without fusion emitters, XLA compiles in half to two thirds of the time. The compiled code is as
    fast, except for events with unilateral contact, where it is slower by a seventh. Programs whose
    digits must not depend on the process always set this option.
    """
    can_set_emitters_flag = accepts_fusion_emitters_flag() and jax.default_backend() == "cpu"
    return {FUSION_EMITTERS_FLAG: are_fusion_emitters_enabled} if can_set_emitters_flag else {}


def accepts_fusion_emitters_flag() -> bool:
    """Return whether this version of XLA accepts the flag for fusion emitters.

    A version that does not accept the flag may abort the process on receiving it.
    """
    return jax.__version_info__[:2] in ((0, 9), (0, 10))
