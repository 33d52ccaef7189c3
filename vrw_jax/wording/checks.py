"""What callers give: looked at once, here, for every public function.

A sentence says what was given, what is allowed and what to do. What is no number at all is a
TypeError, a number that can't be meant a ValueError.
"""

import difflib
import math
import os
from collections.abc import Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array


def nearest(name: object, allowed: Iterable[str]) -> str:
    """' (did you mean ...?)' where a name like it is allowed, else nothing."""
    close = difflib.get_close_matches(str(name), list(allowed), n=1, cutoff=0.5)
    return f" (did you mean '{close[0]}'?)" if close else ""


def require_known(name: Any, allowed: Sequence[str], what: str) -> None:
    """Refuse a name that is none of those `allowed`: "'dampng' is no parameter ..."."""
    if name not in allowed:
        choice = ", ".join(allowed)
        raise ValueError(
            f"{shown(name)} is no {what}{nearest(name, allowed)}: choose from {choice}."
        )


def shown(value: object) -> str:
    """A value as a sentence tells it: itself where it is short, else its kind."""
    if isinstance(value, jax.Array | np.ndarray) and np.ndim(value):
        return f"an array of shape {np.shape(value)}"
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"a {type(value).__name__}"


def _is_number(value: object) -> bool:
    """Whether it is one real number; True and False are none."""
    kind = np.asarray(value).dtype.kind if isinstance(value, float | int | np.generic) else "O"
    if isinstance(value, jax.Array | np.ndarray) and np.ndim(value) == 0:
        kind = np.dtype(value.dtype).kind
    return kind in "fiu"


def whole(name: str, value: Any, least: int = 1, why: str = "") -> int:
    """A whole number of at least `least`; `why` says why so many."""
    number = _is_number(value) and not isinstance(value, jax.core.Tracer)
    if not number or np.asarray(value).dtype.kind not in "iu" or value < least:
        raise (ValueError if number else TypeError)(
            f"{name} is {shown(value)}, but it must be a whole number of at least {least}{why}: "
            f"give {name} = {least}, say."
        )
    return int(value)


def real(name: str, value: Any) -> float:
    """One finite number."""
    if not _is_number(value) or isinstance(value, jax.core.Tracer):
        raise TypeError(f"{name} is {shown(value)}, but it is one real number: give it as a float.")
    if not math.isfinite(value):
        raise ValueError(f"{name} is {float(value):g}, but it must be finite: give a number.")
    return float(value)


def positive(name: str, value: Any) -> float:
    """One number above zero."""
    if not real(name, value) > 0.0:
        raise ValueError(
            f"{name} is {float(value):g}, but it must be positive: give a number above 0."
        )
    return float(value)


def range_of(name: str, pair: Any) -> tuple[float, float]:
    """Two numbers, the lower first."""
    try:
        low, high = pair
    except (TypeError, ValueError):
        raise TypeError(
            f"{name} is {shown(pair)}, but it is a lower and an upper bound: write (lower, upper)."
        ) from None
    low, high = real(f"the lower end of {name}", low), real(f"the upper end of {name}", high)
    if not low < high:
        raise ValueError(
            f"{name} is ({low:g}, {high:g}), which holds nothing: give a lower one below the upper."
        )
    return low, high


def reals(name: str, value: Any, advice: str = "give a number, or an array of them") -> Array:
    """Real numbers of any shape as a strongly typed array; Python's take JAX's default type."""
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError, OverflowError):
        array = None
    except (RuntimeError, AssertionError):
        _require_device()  # the first array of a process finds out what it may run on
        raise
    if array is None or not (
        jnp.issubdtype(array.dtype, jnp.floating) or jnp.issubdtype(array.dtype, jnp.integer)
    ):
        raise TypeError(f"{name} is {shown(value)}, but it holds real numbers: {advice}.")
    if not jnp.issubdtype(array.dtype, jnp.floating):
        array = array.astype(jnp.result_type(float))
    return jax.lax.convert_element_type(array, np.dtype(array.dtype))


def known_reals(
    name: str, value: Any, advice: str = "give a number, or an array of them"
) -> np.ndarray:
    """`reals` where numbers are known, as numpy holds them: JAX need not see what is sound."""
    if isinstance(value, np.ndarray) and value.dtype == jax.dtypes.canonicalize_dtype(float):
        return value
    return np.asarray(reals(name, value, advice))


def _require_device() -> None:
    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:  # a plugin without its device asserts
        asked = os.environ.get("JAX_PLATFORMS")
        raise OSError(
            f"JAX_PLATFORMS is {asked!r}, but JAX finds no device of that kind: unset it, or set it"
            " to cpu, before Python starts."
        ) from error


def flag(name: str, value: Any) -> bool:
    """True or False."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} is {shown(value)}, but it is a choice: give True or False.")
    return bool(value)


def chosen(name: str, value: Any, allowed: Sequence[str]) -> str:
    """One of several words."""
    if not isinstance(value, str):
        raise TypeError(f"{name} is {shown(value)}, but it is a word: give '{allowed[0]}', say.")
    if value not in allowed:
        raise ValueError(
            f"{name} is {value!r}{nearest(value, allowed)}, but it must be one of "
            f"{', '.join(map(repr, allowed))}: choose among these."
        )
    return value


def names_of(name: str, value: Any) -> tuple[str, ...]:
    """Several names; one alone may be given as it is."""
    values = (value,) if isinstance(value, str) else value
    if not isinstance(values, Iterable) or not all(isinstance(v, str) for v in (*values,)):
        raise TypeError(f'{name} is {shown(value)}, but it holds names: write ["dls_fraction"].')
    return tuple(values)


def instance(name: str, value: Any, kind: type | tuple[type, ...], advice: str) -> None:
    """Refuse what is not of this kind."""
    if not isinstance(value, kind):
        one = (kind[0] if isinstance(kind, tuple) else kind).__name__
        article = "an" if one[0] in "AEIOU" else "a"
        raise TypeError(f"{name} is {shown(value)}, but it must be {article} {one}: {advice}.")


def function_of(name: str, value: Any, what: str) -> None:
    """Refuse what can't be called."""
    if not callable(value):
        raise TypeError(f"{name} is {shown(value)}, but it must be a function: give one {what}.")


def traced(*trees: Any) -> bool:
    """Whether numbers are unknown here, as inside `jit`, `vmap` or `grad`."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))


def untraced(function: str, instead: str, *trees: Any) -> None:
    """Refuse to run inside `jit`, `vmap` or `grad`, for what runs on the host."""
    if traced(*trees):
        raise TypeError(
            f"{function} is called inside jit, vmap or grad, but it runs on known numbers: call it "
            f"outside, or {instead}."
        )
