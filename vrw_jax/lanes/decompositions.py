"""Primitives without a rule of their own, written in terms of others, for one lane."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax


def _find_extremum(is_better: Callable, x: jax.Array, *, axes: Any, index_dtype: Any) -> Any:
    """Return the index of the first NaN on an axis, or else of its first extreme entry."""
    x = x.astype(jnp.int32) if x.dtype == bool else x
    is_float = jnp.issubdtype(x.dtype, jnp.floating)
    best, *others = (
        lax.index_in_dim(x, i, axes[0], keepdims=False) for i in range(x.shape[axes[0]])
    )
    index = jnp.zeros(best.shape, index_dtype)
    for i, entry in enumerate(others, 1):
        is_better_entry = is_better(entry, best)
        if is_float:
            is_better_entry |= (entry != entry) & (best == best)
        index = jnp.where(is_better_entry, jnp.asarray(i, index_dtype), index)
        best = jnp.where(is_better_entry, entry, best)
    return index


def _select_case(index: jax.Array, *cases: jax.Array) -> jax.Array:
    select = lambda selected, i: lax.select(index == i, cases[i], selected)
    return functools.reduce(select, range(1, len(cases)), cases[0])


def _locate_window(
    x: jax.Array, index: jax.Array, axes: Sequence[int], sizes: Sequence[int]
) -> tuple[list[Any], jax.Array]:
    """Return the start of the window of a gather or scatter, and whether it is inside the array."""
    starts: list[Any] = [jnp.zeros((), index.dtype)] * x.ndim
    is_inside = jnp.asarray(True)
    for position, axis in enumerate(axes):
        starts[axis] = index[position]
        is_inside &= (starts[axis] >= 0) & (starts[axis] <= x.shape[axis] - sizes[axis])
    return starts, is_inside


def _gather(
    x: jax.Array,
    indices: jax.Array,
    *,
    dimension_numbers: Any,
    slice_sizes: Any,
    mode: Any,
    fill_value: Any,
    **_: Any,
) -> jax.Array:
    _require_no_batch(dimension_numbers.operand_batching_dims)
    if fill_value is None and jnp.issubdtype(x.dtype, jnp.inexact):
        fill_value = jnp.nan
    elif fill_value is None:
        fill_value = x.dtype == bool or (
            jnp.iinfo(x.dtype).min if x.dtype.kind == "i" else jnp.iinfo(x.dtype).max
        )
    windows = []
    for index in indices.reshape(-1, indices.shape[-1]):
        starts, is_inside = _locate_window(x, index, dimension_numbers.start_index_map, slice_sizes)
        window = lax.squeeze(
            lax.dynamic_slice(x, starts, slice_sizes), dimension_numbers.collapsed_slice_dims
        )
        if mode == lax.GatherScatterMode.FILL_OR_DROP:
            window = jnp.where(is_inside, window, jnp.asarray(fill_value, x.dtype))
        windows.append(window)
    gathered = jnp.stack(windows).reshape(*indices.shape[:-1], *windows[0].shape)
    n_batch = indices.ndim - 1
    batch_axes = [a for a in range(gathered.ndim) if a not in dimension_numbers.offset_dims]
    return jnp.moveaxis(gathered, range(n_batch), batch_axes)


def _scatter(
    combine: Callable,
    x: jax.Array,
    indices: jax.Array,
    updates: jax.Array,
    *,
    dimension_numbers: Any,
    mode: Any,
    **_: Any,
) -> jax.Array:
    _require_no_batch(dimension_numbers.operand_batching_dims)
    inserted = dimension_numbers.inserted_window_dims
    window_axes = dimension_numbers.update_window_dims
    batch_axes = [a for a in range(updates.ndim) if a not in window_axes]
    window_sizes = iter(updates.shape[a] for a in window_axes)
    sizes = [1 if axis in inserted else next(window_sizes) for axis in range(x.ndim)]
    updates = jnp.moveaxis(updates, batch_axes, range(len(batch_axes))).reshape(-1, *sizes)
    rows = indices.reshape(-1, indices.shape[-1])
    for index, update in zip(rows, updates, strict=True):
        starts, is_inside = _locate_window(
            x, index, dimension_numbers.scatter_dims_to_operand_dims, sizes
        )
        previous = lax.dynamic_slice(x, starts, sizes)
        changed = combine(previous, update)
        if mode == lax.GatherScatterMode.FILL_OR_DROP:
            changed = jnp.where(is_inside, changed, previous)
        x = lax.dynamic_update_slice(x, changed, starts)
    return x


def _reverse(x: jax.Array, *, dimensions: Sequence[int]) -> jax.Array:
    for axis in dimensions:
        entries = [lax.slice_in_dim(x, i, i + 1, axis=axis) for i in range(x.shape[axis])]
        x = lax.concatenate(entries[::-1], axis)
    return x


def _require_no_batch(batching_dims: Sequence[int]) -> None:
    if batching_dims:
        raise NotImplementedError("an index array with a batch axis has no rule for lanes")


def _expm1(x: jax.Array, **_: Any) -> jax.Array:
    """Return exp(x) - 1 by W. Kahan's quotient (u - 1) / log(u), in which the rounding error of
    u = exp(x) cancels.
    """
    u = jnp.exp(x)
    is_small, is_minus_one = u == 1.0, u - 1.0 == -1.0
    is_simple = is_small | is_minus_one | jnp.isinf(u)
    ratio = x / jnp.where(is_simple, 1.0, jnp.log(jnp.where(is_simple, 2.0, u)))
    return jnp.where(is_small, x, jnp.where(is_simple, u - 1.0, (u - 1.0) * ratio))


def _log1p(x: jax.Array, **_: Any) -> jax.Array:
    u = 1.0 + x
    is_simple = (u == 1.0) | (u == jnp.inf)
    return jnp.where(is_simple, x, jnp.log(u) * (x / jnp.where(is_simple, 1.0, u - 1.0)))


def _tanh(x: jax.Array, **_: Any) -> jax.Array:
    t = _expm1(-2.0 * jnp.abs(x))
    return jnp.where(x < 0.0, t, -t) / (t + 2.0)


def _sinh(x: jax.Array, **_: Any) -> jax.Array:
    t = _expm1(jnp.abs(x))
    magnitude = 0.5 * (t + jnp.where(t == jnp.inf, 1.0, t / (t + 1.0)))
    return jnp.where(x < 0.0, -magnitude, magnitude)


def _atan2(y: jax.Array, x: jax.Array, **_: Any) -> jax.Array:
    """Return the angle of a vector: that of a polynomial with an error of 1e-5 (Abramowitz and
    Stegun 4.4.49), corrected by the sine of its difference to the angle.
    """
    is_below = jnp.signbit(y)
    is_infinite = (jnp.isinf(x) | jnp.isinf(y)) & (x == x) & (y == y)
    shrink = lambda z: jnp.where(jnp.isinf(z), jnp.where(z < 0.0, -1.0, 1.0), 0.0)
    y, x = (jnp.where(is_infinite, shrink(z), z) for z in (y, x))
    largest = jnp.maximum(jnp.abs(x), jnp.abs(y))
    scale = jnp.where(largest == 0.0, 1.0, largest)
    y, x = y / scale, x / scale
    ratio = jnp.minimum(jnp.abs(x), jnp.abs(y))
    square = ratio * ratio
    angle = ratio * (
        0.9998660
        + square * (-0.3302995 + square * (0.1801410 + square * (-0.0851330 + square * 0.0208351)))
    )
    angle = jnp.where(jnp.abs(y) > jnp.abs(x), 0.5 * jnp.pi - angle, angle)
    angle = jnp.where(jnp.signbit(x), jnp.pi - angle, angle)
    angle = jnp.where(is_below, -angle, angle)
    radius = jnp.sqrt(x * x + y * y)
    sine = (y * jnp.cos(angle) - x * jnp.sin(angle)) / jnp.where(radius == 0.0, 1.0, radius)
    return angle + (sine + sine * sine * sine / 6.0)


def _asinh(x: jax.Array, **_: Any) -> jax.Array:
    size = jnp.abs(x)
    is_large = size > 1e8  # 1 + size**2 is size**2 to round-off
    part = jnp.where(is_large, 0.0, size)
    magnitude = _log1p(part + part * part / (1.0 + jnp.sqrt(1.0 + part * part)))
    magnitude = jnp.where(is_large, jnp.log(size) + math.log(2.0), magnitude)
    return jnp.where(x < 0.0, -magnitude, magnitude)


def _acosh(x: jax.Array, **_: Any) -> jax.Array:
    is_large = x > 1e8
    part = jnp.where(is_large, 1.0, jnp.where(x < 1.0, jnp.nan, x))
    magnitude = _log1p((part - 1.0) + jnp.sqrt((part - 1.0) * (part + 1.0)))
    return jnp.where(is_large, jnp.log(x) + math.log(2.0), magnitude)


def _atanh(x: jax.Array, **_: Any) -> jax.Array:
    size = jnp.abs(x)
    part = jnp.where(size == 1.0, 0.0, size)
    magnitude = 0.5 * _log1p(2.0 * part / (1.0 - part))
    magnitude = jnp.where(size == 1.0, jnp.inf, magnitude)
    return jnp.where(x < 0.0, -magnitude, magnitude)


def _pow(x: jax.Array, y: jax.Array, **_: Any) -> jax.Array:
    if not jnp.issubdtype(y.dtype, jnp.floating):
        y = y.astype(x.dtype)
    magnitude = jnp.exp(y * jnp.log(jnp.where(x == 0.0, 1.0, jnp.abs(x))))
    at_zero = jnp.where(y > 0.0, 0.0, jnp.where(y < 0.0, jnp.inf, y))
    half = 0.5 * y
    is_odd = half != jnp.floor(half)
    of_fraction = jnp.where(x == -jnp.inf, magnitude, jnp.nan)
    of_negative = jnp.where(
        y == jnp.floor(y), jnp.where(is_odd, -magnitude, magnitude), of_fraction
    )
    power = jnp.where(x == 0.0, at_zero, jnp.where(x < 0.0, of_negative, magnitude))
    return jnp.where((y == 0.0) | (x == 1.0), 1.0, power)


def _cbrt(x: jax.Array, **_: Any) -> jax.Array:
    size = jnp.abs(x)
    root = jnp.exp(jnp.log(jnp.where(size > 0.0, size, 1.0)) / 3.0)
    root = root - (root - size / (root * root)) / 3.0  # Newton's step removes the error of exp.
    is_simple = (size == 0.0) | (size == jnp.inf)
    return jnp.where(is_simple, x, jnp.where(x < 0.0, -root, root))


def _multiply(
    left: jax.Array,
    right: jax.Array,
    *,
    dimension_numbers: Any,
    preferred_element_type: Any = None,
    **_: Any,
) -> jax.Array:
    """Return a product of arrays as a sum of elementwise products."""
    (summed_left, summed_right), (batch_left, batch_right) = dimension_numbers
    first_left, first_right = (*summed_left, *batch_left), (*summed_right, *batch_right)
    free_left, free_right = (
        [axis for axis in range(x.ndim) if axis not in first_axes]
        for x, first_axes in ((left, first_left), (right, first_right))
    )
    n, n_left, n_right = map(len, (first_left, free_left, free_right))
    dtype = preferred_element_type or jnp.result_type(left, right)
    left, right = (
        jnp.expand_dims(lax.transpose(x, order), new_axes).astype(dtype)
        for x, order, new_axes in (
            (left, (*first_left, *free_left), tuple(range(n + n_left, n + n_left + n_right))),
            (right, (*first_right, *free_right), tuple(range(n, n + n_left))),
        )
    )
    return jnp.sum(left * right, tuple(range(len(summed_left))), dtype)


DECOMPOSITIONS: dict[str, Callable[..., Any]] = {
    "acos": lambda x, **_: _atan2(jnp.sqrt((1.0 - x) * (1.0 + x)), x),
    "acosh": _acosh,
    "argmax": functools.partial(_find_extremum, lax.gt),
    "argmin": functools.partial(_find_extremum, lax.lt),
    "asin": lambda x, **_: _atan2(x, jnp.sqrt((1.0 - x) * (1.0 + x))),
    "asinh": _asinh,
    "atan": lambda x, **_: _atan2(x, jnp.ones_like(x)),
    "atan2": _atan2,
    "atanh": _atanh,
    "cbrt": _cbrt,
    "ceil": lambda x: -jnp.floor(-x),
    "clamp": lambda lower, x, upper: jnp.minimum(jnp.maximum(x, lower), upper),
    "cosh": lambda x, **_: 0.5 * (jnp.exp(x) + jnp.exp(-x)),
    "dot_general": _multiply,
    "expm1": _expm1,
    "gather": _gather,
    "log1p": _log1p,
    "logistic": lambda x, **_: 1.0 / (1.0 + jnp.exp(-x)),
    "pow": _pow,
    "rev": _reverse,
    "rsqrt": lambda x, **_: 1.0 / jnp.sqrt(x),
    "scatter": functools.partial(_scatter, lambda previous, update: update),
    "scatter-add": functools.partial(_scatter, jnp.add),
    "scatter-mul": functools.partial(_scatter, jnp.multiply),
    "select_n": _select_case,
    "sign": lambda x: jnp.where(x > 0, 1, jnp.where(x < 0, -1, x)).astype(x.dtype),
    "sinh": _sinh,
    "tan": lambda x, **_: jnp.sin(x) / jnp.cos(x),
    "tanh": _tanh,
}
"""Functions of the operands and parameters of a primitive, by its name."""
