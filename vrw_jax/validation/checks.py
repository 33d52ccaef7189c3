"""Validation of the arguments of all public functions.

A message states the given value, the allowed values and the remedy. A value that is no number
raises a TypeError, a number out of range a ValueError.
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


def suggest_name(name: object, allowed_names: Iterable[str]) -> str:
    """Return ' (did you mean ...?)' if a similar name is allowed, otherwise ''."""
    close_matches = difflib.get_close_matches(str(name), list(allowed_names), n=1, cutoff=0.5)
    return f" (did you mean '{close_matches[0]}'?)" if close_matches else ""


def check_known_name(name: Any, allowed_names: Sequence[str], description: str) -> None:
    """Raise a ValueError for a name that is not in `allowed_names`: "'dampng' is no
    parameter ...".
    """
    if name not in allowed_names:
        allowed_text = ", ".join(allowed_names)
        raise ValueError(
            f"{format_value(name)} is no {description}{suggest_name(name, allowed_names)}: choose from {allowed_text}."
        )


def format_value(value: object) -> str:
    """Return a value as text for a message: its repr if short, otherwise its type."""
    if isinstance(value, jax.Array | np.ndarray) and np.ndim(value):
        return f"an array of shape {np.shape(value)}"
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"a {type(value).__name__}"


def _is_number(value: object) -> bool:
    """Return whether a value is one real number; True and False are not."""
    dtype_kind = (
        np.asarray(value).dtype.kind if isinstance(value, float | int | np.generic) else "O"
    )
    if isinstance(value, jax.Array | np.ndarray) and np.ndim(value) == 0:
        dtype_kind = np.dtype(value.dtype).kind
    return dtype_kind in "fiu"


def check_int(name: str, value: Any, min_value: int = 1, reason: str = "") -> int:
    """Return an integer of at least `min_value`; `reason` explains the limit in the message."""
    is_number = _is_number(value) and not isinstance(value, jax.core.Tracer)
    if not is_number or np.asarray(value).dtype.kind not in "iu" or value < min_value:
        raise (ValueError if is_number else TypeError)(
            f"{name} is {format_value(value)}, but it must be a whole number of at least {min_value}{reason}: "
            f"give {name} = {min_value}, say."
        )
    return int(value)


def check_real(name: str, value: Any) -> float:
    """Return one finite number."""
    if not _is_number(value) or isinstance(value, jax.core.Tracer):
        raise TypeError(
            f"{name} is {format_value(value)}, but it is one real number: give it as a float."
        )
    if not math.isfinite(value):
        raise ValueError(f"{name} is {float(value):g}, but it must be finite: give a number.")
    return float(value)


def check_positive(name: str, value: Any) -> float:
    """Return one number above zero."""
    if not check_real(name, value) > 0.0:
        raise ValueError(
            f"{name} is {float(value):g}, but it must be positive: give a number above 0."
        )
    return float(value)


def check_range(name: str, bounds: Any) -> tuple[float, float]:
    """Return two numbers, the lower first."""
    try:
        low, high = bounds
    except (TypeError, ValueError):
        raise TypeError(
            f"{name} is {format_value(bounds)}, but it is a lower and an upper bound: write (lower, upper)."
        ) from None
    low, high = (
        check_real(f"the lower end of {name}", low),
        check_real(f"the upper end of {name}", high),
    )
    if not low < high:
        raise ValueError(
            f"{name} is ({low:g}, {high:g}), which holds nothing: give a lower one below the upper."
        )
    return low, high


def check_reals(name: str, value: Any, advice: str = "give a number, or an array of them") -> Array:
    """Return real numbers of any shape as a strongly typed array.

    Python numbers get JAX's default type.
    """
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError, OverflowError):
        array = None
    except (RuntimeError, AssertionError):
        _check_device()  # the first array of a process initializes JAX's backend
        raise
    if array is None or not (
        jnp.issubdtype(array.dtype, jnp.floating) or jnp.issubdtype(array.dtype, jnp.integer)
    ):
        raise TypeError(f"{name} is {format_value(value)}, but it holds real numbers: {advice}.")
    if not jnp.issubdtype(array.dtype, jnp.floating):
        array = array.astype(jnp.result_type(float))
    return jax.lax.convert_element_type(array, np.dtype(array.dtype))


def check_numpy_reals(
    name: str, value: Any, advice: str = "give a number, or an array of them"
) -> np.ndarray:
    """Return concrete real numbers as a numpy array, without JAX if they are already valid."""
    if isinstance(value, np.ndarray) and value.dtype == jax.dtypes.canonicalize_dtype(float):
        return value
    return np.asarray(check_reals(name, value, advice))


def _check_device() -> None:
    """Raise an OSError if JAX finds no device."""
    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:  # a plugin without its device asserts
        requested = os.environ.get("JAX_PLATFORMS")
        raise OSError(
            f"JAX_PLATFORMS is {requested!r}, but JAX finds no device of that kind: unset it, or set it"
            " to cpu, before Python starts."
        ) from error


def check_bool(name: str, value: Any) -> bool:
    """Return True or False."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} is {format_value(value)}, but it is a choice: give True or False.")
    return bool(value)


def check_choice(name: str, value: Any, allowed_names: Sequence[str]) -> str:
    """Return one of several allowed words."""
    if not isinstance(value, str):
        raise TypeError(
            f"{name} is {format_value(value)}, but it is a word: give '{allowed_names[0]}', say."
        )
    if value not in allowed_names:
        raise ValueError(
            f"{name} is {value!r}{suggest_name(value, allowed_names)}, but it must be one of "
            f"{', '.join(map(repr, allowed_names))}: choose among these."
        )
    return value


def check_names(name: str, value: Any) -> tuple[str, ...]:
    """Return several names; a single string counts as one name."""
    values = (value,) if isinstance(value, str) else value
    if not isinstance(values, Iterable) or not all(isinstance(v, str) for v in (*values,)):
        raise TypeError(
            f'{name} is {format_value(value)}, but it holds names: write ["dls_fraction"].'
        )
    return tuple(values)


def check_type(name: str, value: Any, expected_type: type | tuple[type, ...], advice: str) -> None:
    """Raise a TypeError unless a value has this type."""
    if not isinstance(value, expected_type):
        type_name = (
            expected_type[0] if isinstance(expected_type, tuple) else expected_type
        ).__name__
        article = "an" if type_name[0] in "AEIOU" else "a"
        raise TypeError(
            f"{name} is {format_value(value)}, but it must be {article} {type_name}: {advice}."
        )


def check_callable(name: str, value: Any, description: str) -> None:
    """Raise a TypeError unless a value is callable."""
    if not callable(value):
        raise TypeError(
            f"{name} is {format_value(value)}, but it must be a function: give one {description}."
        )


def is_traced(*trees: Any) -> bool:
    """Return whether some number is a tracer, as inside `jit`, `vmap` or `grad`."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))


def check_not_traced(function: str, alternative: str, *trees: Any) -> None:
    """Raise a TypeError inside `jit`, `vmap` or `grad`, for functions that run on the host."""
    if is_traced(*trees):
        raise TypeError(
            f"{function} is called inside jit, vmap or grad, but it runs on known numbers: call it "
            f"outside, or {alternative}."
        )
