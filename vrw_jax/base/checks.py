"""Validation of the arguments of all public functions.

An error message states the given value, the allowed values and the remedy. A value that is not a
number raises a TypeError, and a number out of range raises a ValueError.
"""

import difflib
import math
import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax._src import xla_bridge
from jaxtyping import Array

MAX_INT64 = np.iinfo(np.int64).max
"""Largest integer that is accepted, chosen because arrays use 64-bit indices."""

_process_fork_state = {"is_forked": False}
"""Flag that states whether this process was forked after JAX had been initialized."""


if hasattr(os, "register_at_fork"):  # Windows has no fork.
    os.register_at_fork(
        after_in_child=lambda: _process_fork_state.update(
            is_forked=_process_fork_state["is_forked"] or xla_bridge.backends_are_initialized()
        )
    )


def raise_if_process_forked() -> None:
    """Raise a RuntimeError in a forked process, where JAX would wait forever for missing
    threads.
    """
    if _process_fork_state["is_forked"]:
        raise RuntimeError(
            "this process was forked after JAX had made an array, and JAX's threads are not copied,"
            " so that it would wait for ever: start processes with "
            'multiprocessing.get_context("spawn") or "forkserver".'
        )


def format_name_suggestion(given_name: object, allowed_names: Iterable[str]) -> str:
    """Return " (did you mean ...?)" with the most similar allowed name, or "" if no name is
    similar.
    """
    similar_names = difflib.get_close_matches(str(given_name), list(allowed_names), n=1, cutoff=0.5)
    return f" (did you mean '{similar_names[0]}'?)" if similar_names else ""


def require_known_name(given_name: Any, allowed_names: Sequence[str], name_kind: str) -> None:
    """Raise a ValueError if a name is not one of the allowed names."""
    if not isinstance(given_name, str) or given_name not in allowed_names:
        allowed_names_text = ", ".join(allowed_names)
        raise ValueError(
            f"{format_value(given_name)} is no "
            f"{name_kind}{format_name_suggestion(given_name, allowed_names)}: "
            f"choose from {allowed_names_text}."
        )


def format_value(given_value: object) -> str:
    """Return the text of a value for an error message.

    The text is the value's repr if that is short, and else the value's type.
    """
    if isinstance(given_value, jax.Array | np.ndarray) and np.ndim(given_value):
        return f"an array of shape {np.shape(given_value)}"
    try:
        value_text = " ".join(repr(given_value).split())
    # The repr of a foreign object may raise any error, and an integer may be too long to print.
    except Exception:
        return f"a {type(given_value).__name__}"
    if len(value_text) <= 60:
        return value_text
    return (
        f"a number of {len(value_text)} digits"
        if type(given_value) is int
        else f"a {type(given_value).__name__}"
    )


def _is_single_number(given_value: Any) -> bool:
    """Return whether a value is a single real number. Bools and tracers are not numbers in this
    sense.
    """
    if isinstance(given_value, int | float) and not isinstance(given_value, bool):
        return True
    if isinstance(given_value, jax.core.Tracer) or np.ma.is_masked(given_value):
        return False
    is_array_type = isinstance(given_value, jax.Array | np.ndarray | np.generic)
    # The dtype of random keys has no kind.
    dtype_kind = getattr(given_value.dtype, "kind", "O") if is_array_type else "O"
    return dtype_kind in "fiu" and np.ndim(given_value) == 0


def check_int(
    argument_name: str, given_value: Any, min_value: int = 1, min_value_reason: str = ""
) -> int:
    """Return the given integer. Raise an error if it is not an integer of at least `min_value`.

    The clause `min_value_reason` explains the limit in the error message.
    """
    raise_if_process_forked()
    is_single_number = _is_single_number(given_value)
    is_whole_number = is_single_number and (
        isinstance(given_value, int) or np.asarray(given_value).dtype.kind in "iu"
    )
    if is_whole_number and int(given_value) > MAX_INT64:
        raise ValueError(
            f"{argument_name} is {format_value(given_value)}, but it must be at most "
            f"{MAX_INT64:,}: give a smaller one."
        )
    if not is_whole_number or int(given_value) < min_value:
        raise (ValueError if is_single_number else TypeError)(
            f"{argument_name} is {format_value(given_value)}, but it must be a whole number of at "
            f"least {min_value}{min_value_reason}: give {argument_name} = {min_value}, say."
        )
    return int(given_value)


def check_real(argument_name: str, given_value: Any) -> float:
    """Return the given number as a float. Raise an error if it is not one finite real number."""
    raise_if_process_forked()
    if not _is_single_number(given_value):
        raise TypeError(
            f"{argument_name} is {format_value(given_value)}, but it is one real number: give it "
            "as a float."
        )
    try:
        real_number = float(given_value)
    except OverflowError:  # An integer of hundreds of digits exceeds the largest float.
        real_number = math.inf
    if not math.isfinite(real_number):
        raise ValueError(
            f"{argument_name} is {format_value(given_value)}, but it must be finite: give a number."
        )
    return real_number


def check_positive(argument_name: str, given_value: Any) -> float:
    """Return the given number as a float. Raise an error if it is not one positive number."""
    if not check_real(argument_name, given_value) > 0.0:
        raise ValueError(
            f"{argument_name} is {float(given_value):g}, but it must be positive: give a number "
            "above 0."
        )
    return float(given_value)


def check_range(argument_name: str, given_range: Any) -> tuple[float, float]:
    """Return a lower and an upper bound as floats. Raise an error if the value is not such a
    pair.
    """
    try:
        lower_bound, upper_bound = given_range
    except (TypeError, ValueError):
        raise TypeError(
            f"{argument_name} is {format_value(given_range)}, but it is a lower and an upper "
            "bound: write (lower, upper)."
        ) from None
    lower_bound = check_real(f"the lower end of {argument_name}", lower_bound)
    upper_bound = check_real(f"the upper end of {argument_name}", upper_bound)
    if not lower_bound < upper_bound:
        raise ValueError(
            f"{argument_name} is ({lower_bound:g}, {upper_bound:g}), which holds nothing: give "
            "a lower one below the upper."
        )
    return lower_bound, upper_bound


def require_no_masked_entries(argument_name: str, given_value: Any) -> None:
    """Raise a TypeError if an array, or an array in nested lists, has a masked entry.

    The number below a mask has no meaning.
    """

    def has_masked_entry(value: Any) -> bool:
        if isinstance(value, list | tuple):
            return any(map(has_masked_entry, value))
        return isinstance(value, np.ma.MaskedArray) and bool(np.ma.is_masked(value))

    if has_masked_entry(given_value):
        raise TypeError(
            f"{argument_name} has masked entries, which are no numbers: give only the others, as "
            "array.compressed() returns them, or fill the gaps with array.filled(value)."
        )


def _convert_to_plain_array(given_value: Any) -> Any:
    """Return an array in native byte order and without a mask. Return other values unchanged.

    JAX accepts neither another byte order nor a mask, even if the mask covers no entry.
    """
    dtype = getattr(given_value, "dtype", None)
    if isinstance(given_value, np.ndarray) or not getattr(dtype, "isnative", True):
        return np.asarray(given_value, dtype.newbyteorder("="))  # type: ignore[union-attr]
    return given_value


def check_reals(
    argument_name: str, given_value: Any, remedy_text: str = "give a number, or an array of them"
) -> Array:
    """Return real numbers of any shape as a strongly typed JAX array.

    Raise an error if the value does not consist of real numbers. Python numbers get JAX's default
    type.
    """
    raise_if_process_forked()
    require_no_masked_entries(argument_name, given_value)
    try:
        given_value = jax.tree.map(_convert_to_plain_array, given_value)
        if isinstance(
            given_value, np.ndarray
        ) and given_value.dtype == jax.dtypes.canonicalize_dtype(float):
            # jnp.asarray would compile a program for each shape. The copy keeps its values if the
            # caller changes the array.
            return jax.device_put(given_value.copy())
        real_array = jnp.asarray(given_value)
    except (TypeError, ValueError, OverflowError):
        real_array = None
    except Exception:  # The conversion of a foreign object may raise any error.
        # The first array of a process may fail because there is no device.
        try:
            jax.devices()
        # A plugin raises an AssertionError if its device is missing.
        except (RuntimeError, AssertionError) as device_error:
            requested_jax_platforms = os.environ.get("JAX_PLATFORMS")
            raise OSError(
                f"JAX_PLATFORMS is {requested_jax_platforms!r}, but JAX finds no device of that "
                "kind: unset it, or set it to cpu, before Python starts."
            ) from device_error
        real_array = None
    if real_array is None or not (
        jnp.issubdtype(real_array.dtype, jnp.floating)
        or jnp.issubdtype(real_array.dtype, jnp.integer)
    ):
        raise TypeError(
            f"{argument_name} is {format_value(given_value)}, but it holds real numbers: "
            f"{remedy_text}."
        )
    if not jnp.issubdtype(real_array.dtype, jnp.floating):
        real_array = real_array.astype(jnp.result_type(float))
    return jax.lax.convert_element_type(real_array, np.dtype(real_array.dtype))


def check_numpy_reals(
    argument_name: str, given_value: Any, remedy_text: str = "give a number, or an array of them"
) -> np.ndarray:
    """Return real numbers as a NumPy array. A valid NumPy array is not copied.

    Raise an error if the value does not consist of real numbers.
    """
    raise_if_process_forked()
    require_no_masked_entries(argument_name, given_value)
    if isinstance(given_value, np.ndarray) and given_value.dtype == jax.dtypes.canonicalize_dtype(
        float
    ):
        return np.asarray(given_value)
    return np.asarray(check_reals(argument_name, given_value, remedy_text))


def check_bool(argument_name: str, given_value: Any) -> bool:
    """Return the given value as a Python bool. Raise a TypeError if it is not a bool."""
    raise_if_process_forked()
    if not isinstance(given_value, bool | np.bool_):
        raise TypeError(
            f"{argument_name} is {format_value(given_value)}, but it is a choice: give True or "
            "False."
        )
    return bool(given_value)


def check_choice(argument_name: str, given_value: Any, allowed_names: Sequence[str]) -> str:
    """Return the given name. Raise an error if it is not one of `allowed_names`."""
    raise_if_process_forked()
    if not isinstance(given_value, str):
        raise TypeError(
            f"{argument_name} is {format_value(given_value)}, but it must be text: give "
            f"'{allowed_names[0]}', say."
        )
    if given_value not in allowed_names:
        raise ValueError(
            f"{argument_name} is "
            f"{given_value!r}{format_name_suggestion(given_value, allowed_names)}, but it must be "
            f"one of {', '.join(map(repr, allowed_names))}: choose among these."
        )
    return given_value


def check_names(
    argument_name: str, given_value: Any, example_names_text: str = '"dls_fraction"'
) -> tuple[str, ...]:
    """Return the given names as a tuple. A single string is accepted as one name.

    Raise an error if the value is not a string or a collection of strings.
    """
    raise_if_process_forked()
    try:
        given_names = (given_value,) if isinstance(given_value, str) else tuple(given_value)
    except Exception:  # The value is no collection, an array without axes, or a tracer.
        given_names = (None,)
    if not all(isinstance(given_name, str) for given_name in given_names):
        raise TypeError(
            f"{argument_name} is {format_value(given_value)}, but it holds names: write "
            f"[{example_names_text}]."
        )
    return given_names


def check_type(
    argument_name: str, given_value: Any, expected_types: type | tuple[type, ...], remedy_text: str
) -> None:
    """Raise a TypeError if a value does not have one of the expected types."""
    raise_if_process_forked()
    if not isinstance(given_value, expected_types):
        expected_type_name = (
            expected_types[0] if isinstance(expected_types, tuple) else expected_types
        ).__name__
        indefinite_article = "an" if expected_type_name[0] in "AEIOU" else "a"
        raise TypeError(
            f"{argument_name} is {format_value(given_value)}, but it must be {indefinite_article} "
            f"{expected_type_name}: {remedy_text}."
        )


def check_path(argument_name: str, given_value: Any, remedy_text: str) -> Path:
    """Return a path of the local file system, with a leading `~` replaced by the home folder.

    Raise an error if the value is no path, or if it is a URL.
    """
    check_type(argument_name, given_value, (str, Path), remedy_text)
    try:
        encoded_name, problem = os.fsencode(given_value), "have"
    except UnicodeEncodeError:
        encoded_name, problem = b"", "encode"
    if not encoded_name or b"\0" in encoded_name:
        raise ValueError(
            f"{argument_name} is {str(given_value)!r}, but the file system cannot {problem} this "
            f"name: {remedy_text}."
        )
    if URL_PATTERN.match(str(given_value)):
        raise ValueError(
            f"{argument_name} is {str(given_value)!r}, a URL, but files are locked and renamed "
            "here, which takes a local file system: give a local path, and copy to or from the URL."
        )
    try:
        return Path(given_value).expanduser()
    except RuntimeError:
        raise ValueError(
            f"{argument_name} is {str(given_value)!r}, but there is no such user: write "
            f"'./{given_value}' for a name that begins with ~."
        ) from None


URL_PATTERN = re.compile(r"([A-Za-z][\w+.-]+:+)+/")
"""Pattern of the beginning of a URL, such as "s3://", "file:/" or "simplecache::s3://". The scheme
has at least two characters, because one letter is a drive of Windows.
"""


def check_callable(argument_name: str, given_value: Any, function_description: str) -> None:
    """Raise a TypeError if a value is not callable."""
    if not callable(given_value):
        raise TypeError(
            f"{argument_name} is {format_value(given_value)}, but it must be a function: give one "
            f"{function_description}."
        )


def has_traced_leaf(*argument_trees: Any) -> bool:
    """Return whether any leaf of the trees is a tracer, which is the case inside `jit` or
    `vmap`.
    """
    return any(
        isinstance(argument_leaf, jax.core.Tracer)
        for argument_leaf in jax.tree.leaves(argument_trees)
    )


def require_untraced_arguments(function_name: str, remedy_text: str, *argument_trees: Any) -> None:
    """Raise a TypeError if an argument of the function `function_name` is traced.

    The function needs concrete values, which `jit`, `vmap` and `grad` do not provide. The end of
    the error message, `remedy_text`, states what to use instead.
    """
    raise_if_process_forked()
    if has_traced_leaf(*argument_trees):
        raise TypeError(
            f"{function_name} is called inside jit, vmap or grad, but it runs on known numbers: "
            f"call it outside, or {remedy_text}."
        )
