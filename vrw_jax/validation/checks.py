"""Validation of the arguments of all public functions.

A message states the given value, the allowed values and the remedy. A value that is no number
raises a TypeError, a number out of range a ValueError.
"""

import difflib
import math
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax._src import xla_bridge
from jaxtyping import Array

MAX_INTEGER = np.iinfo(np.int64).max
"""Largest accepted integer, chosen because arrays use 64-bit indices."""

_process_state = {"is_forked": False}
"""Whether this process was forked from a process in which JAX had made an array."""


def _record_fork() -> None:
    """Record, in a child process made by fork, whether JAX's threads are missing."""
    _process_state["is_forked"] |= bool(xla_bridge.backends_are_initialized())


if hasattr(os, "register_at_fork"):  # Windows has no fork.
    os.register_at_fork(after_in_child=_record_fork)


def raise_if_forked() -> None:
    """Raise a RuntimeError in a forked process, in which JAX would wait for missing threads."""
    if _process_state["is_forked"]:
        raise RuntimeError(
            "this process was forked after JAX had made an array, and JAX's threads are not copied,"
            " so that it would wait for ever: start processes with "
            'multiprocessing.get_context("spawn") or "forkserver".'
        )


def suggest_name(name: object, allowed_names: Iterable[str]) -> str:
    """Return ' (did you mean ...?)' if a similar name is allowed, otherwise an empty text."""
    close_matches = difflib.get_close_matches(str(name), list(allowed_names), n=1, cutoff=0.5)
    return f" (did you mean '{close_matches[0]}'?)" if close_matches else ""


def check_known_name(name: Any, allowed_names: Sequence[str], description: str) -> None:
    """Raise a ValueError unless the name is one of those allowed, as in "'dampng' is no
    parameter ...".
    """
    if not isinstance(name, str) or name not in allowed_names:
        allowed_text = ", ".join(allowed_names)
        raise ValueError(
            f"{format_value(name)} is no {description}{suggest_name(name, allowed_names)}: "
            f"choose from {allowed_text}."
        )


def format_value(value: object) -> str:
    """Return a value as text for a message: its repr if that is short, otherwise its type."""
    if isinstance(value, jax.Array | np.ndarray) and np.ndim(value):
        return f"an array of shape {np.shape(value)}"
    try:
        text = " ".join(repr(value).split())
    # The repr of a foreign object may raise any error, and an integer may be too long to print.
    except Exception:
        return f"a {type(value).__name__}"
    if len(text) <= 60:
        return text
    return f"a number of {len(text)} digits" if type(value) is int else f"a {type(value).__name__}"


def _is_number(value: object) -> bool:
    """Return whether a value is one real number; True and False are none."""
    if isinstance(value, int) and not isinstance(value, bool):
        return True
    dtype_kind = (
        np.asarray(value).dtype.kind if isinstance(value, float | int | np.generic) else "O"
    )
    if isinstance(value, jax.Array | np.ndarray) and np.ndim(value) == 0:
        dtype_kind = getattr(value.dtype, "kind", "O")  # The dtype of random keys has no kind.
    return dtype_kind in "fiu"


def check_int(name: str, value: Any, min_value: int = 1, reason: str = "") -> int:
    """Return an integer of at least `min_value`; `reason` is a clause that explains this limit."""
    raise_if_forked()
    is_number = _is_number(value) and not isinstance(value, jax.core.Tracer)
    is_whole = is_number and (isinstance(value, int) or np.asarray(value).dtype.kind in "iu")
    if is_whole and int(value) > MAX_INTEGER:
        raise ValueError(
            f"{name} is {format_value(value)}, but it must be at most {MAX_INTEGER:,}: give a "
            f"smaller one."
        )
    if not is_whole or int(value) < min_value:
        raise (ValueError if is_number else TypeError)(
            f"{name} is {format_value(value)}, but it must be a whole number of at least "
            f"{min_value}{reason}: "
            f"give {name} = {min_value}, say."
        )
    return int(value)


def check_real(name: str, value: Any) -> float:
    """Return one finite number as a float; raise an error if the value is none."""
    raise_if_forked()
    if not _is_number(value) or isinstance(value, jax.core.Tracer):
        raise TypeError(
            f"{name} is {format_value(value)}, but it is one real number: give it as a float."
        )
    try:
        number = float(value)
    except OverflowError:  # An integer of hundreds of digits exceeds the largest float.
        number = math.inf
    if not math.isfinite(number):
        raise ValueError(f"{name} is {format_value(value)}, but it must be finite: give a number.")
    return number


def check_positive(name: str, value: Any) -> float:
    """Return one positive number as a float; raise an error if the value is none."""
    if not check_real(name, value) > 0.0:
        raise ValueError(
            f"{name} is {float(value):g}, but it must be positive: give a number above 0."
        )
    return float(value)


def check_range(name: str, bounds: Any) -> tuple[float, float]:
    """Return a lower and an upper bound as floats; raise an error if the value has no such form."""
    try:
        lower_bound, upper_bound = bounds
    except (TypeError, ValueError):
        raise TypeError(
            f"{name} is {format_value(bounds)}, but it is a lower and an upper bound: write "
            f"(lower, upper)."
        ) from None
    lower_bound, upper_bound = (
        check_real(f"the lower end of {name}", lower_bound),
        check_real(f"the upper end of {name}", upper_bound),
    )
    if not lower_bound < upper_bound:
        raise ValueError(
            f"{name} is ({lower_bound:g}, {upper_bound:g}), which holds nothing: give "
            "a lower one below the upper."
        )
    return lower_bound, upper_bound


def check_reals(name: str, value: Any, advice: str = "give a number, or an array of them") -> Array:
    """Return real numbers of any shape as a strongly typed JAX array.

    Python's numbers get JAX's default type.
    """
    raise_if_forked()
    try:
        if isinstance(value, np.ndarray) and value.dtype == jax.dtypes.canonicalize_dtype(float):
            # jnp.asarray would compile a program for each shape. The copy keeps its values if the
            # caller changes the array.
            return jax.device_put(value.copy())
        array = jnp.asarray(value)
    except (TypeError, ValueError, OverflowError):
        array = None
    except Exception:  # The conversion of a foreign object may raise any error.
        _check_device()  # The first array of a process may fail because there is no device.
        array = None
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
    """Return real numbers as a NumPy array; a valid array is returned unchanged."""
    raise_if_forked()
    if isinstance(value, np.ndarray) and value.dtype == jax.dtypes.canonicalize_dtype(float):
        return value
    return np.asarray(check_reals(name, value, advice))


def _check_device() -> None:
    """Raise an OSError if JAX finds no device."""
    try:
        jax.devices()
    # A plugin raises an AssertionError if its device is missing.
    except (RuntimeError, AssertionError) as error:
        requested_platforms = os.environ.get("JAX_PLATFORMS")
        raise OSError(
            f"JAX_PLATFORMS is {requested_platforms!r}, but JAX finds no device of that kind: "
            "unset it, or set it to cpu, before Python starts."
        ) from error


def check_bool(name: str, value: Any) -> bool:
    """Return a Python bool; raise a TypeError if the value is none."""
    raise_if_forked()
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} is {format_value(value)}, but it is a choice: give True or False.")
    return bool(value)


def check_choice(name: str, value: Any, allowed_names: Sequence[str]) -> str:
    """Return one of several names; raise an error if the value is none of them."""
    raise_if_forked()
    if not isinstance(value, str):
        raise TypeError(
            f"{name} is {format_value(value)}, but it must be text: give '{allowed_names[0]}', say."
        )
    if value not in allowed_names:
        raise ValueError(
            f"{name} is {value!r}{suggest_name(value, allowed_names)}, but it must be one of "
            f"{', '.join(map(repr, allowed_names))}: choose among these."
        )
    return value


def check_names(name: str, value: Any, example: str = '"dls_fraction"') -> tuple[str, ...]:
    """Return several names as a tuple; a single name may be given as a string."""
    raise_if_forked()
    try:
        values = (value,) if isinstance(value, str) else tuple(value)
    except Exception:  # The value is no collection, an array without axes, or a tracer.
        values = (None,)
    if not all(isinstance(name, str) for name in values):
        raise TypeError(f"{name} is {format_value(value)}, but it holds names: write [{example}].")
    return values


def check_type(name: str, value: Any, expected_type: type | tuple[type, ...], advice: str) -> None:
    """Raise a TypeError unless a value has the expected type."""
    raise_if_forked()
    if not isinstance(value, expected_type):
        type_name = (
            expected_type[0] if isinstance(expected_type, tuple) else expected_type
        ).__name__
        article = "an" if type_name[0] in "AEIOU" else "a"
        raise TypeError(
            f"{name} is {format_value(value)}, but it must be {article} {type_name}: {advice}."
        )


def check_path(name: str, value: Any, advice: str) -> None:
    """Raise an error unless a value is a path that the file system can encode."""
    check_type(name, value, (str, Path), advice)
    try:
        os.fsencode(value)
    except UnicodeEncodeError:
        raise ValueError(
            f"{name} is {value!r}, but the file system cannot encode this name: {advice}."
        ) from None


def check_callable(name: str, value: Any, description: str) -> None:
    """Raise a TypeError unless a value is callable."""
    if not callable(value):
        raise TypeError(
            f"{name} is {format_value(value)}, but it must be a function: give one {description}."
        )


def is_traced(*trees: Any) -> bool:
    """Return whether any leaf is a tracer, as inside `jit`, `vmap` or `grad`."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))


def check_not_traced(function: str, alternative: str, *trees: Any) -> None:
    """Raise a TypeError inside `jit`, `vmap` or `grad`, for a function that needs concrete
    values.
    """
    raise_if_forked()
    if is_traced(*trees):
        raise TypeError(
            f"{function} is called inside jit, vmap or grad, but it runs on known numbers: call it "
            f"outside, or {alternative}."
        )
