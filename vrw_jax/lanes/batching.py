"""Conversion between functions of a batch and functions of one element.

Batches are on the last axis. Code with independent wheels on the last axis runs several times
faster than the same code for one wheel under `jax.vmap`, which moves the batch to the first axis
inside loops and products. Machine code does not accept that axis.

`unbatch` merges every `vmap`, including nested ones, into the last axis. `append_lane_axis` appends
a lane axis to the arrays of a trace. Values that are the same for all lanes, such as counters of
loops, stay without this axis.
"""

import bisect
import functools
import math
import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jax.extend.core import ClosedJaxpr, Literal
from jaxtyping import Array, PyTree

from vrw_jax.lanes.array_rules import COMBINING_PRIMITIVE_BY_REDUCTION
from vrw_jax.lanes.decompositions import DECOMPOSITIONS
from vrw_jax.lanes.environment import with_default_jax_settings
from vrw_jax.lanes.lowering import (
    CALLED_JAXPR_PARAMETERS,
    NOINLINE_FUNCTION_NAME,
    count_scan_arguments,
    mark_noinline,
)
from vrw_jax.lanes.value_emitter import ELEMENTWISE_RULES

BatchFunction = Callable[..., PyTree[Array]]
"""Function of arrays whose last axis is the batch."""

GPU_BLOCK_SIZE = 32_768
"""Number of batch elements that one call on a GPU computes. The value is chosen because an H100 GPU
finds 40 times as many gaits per second as with batches of 64.
"""


def choose_batch_size(cpu_batch_size: int, gpu_batch_size: int) -> int:
    """Return the batch size for JAX's default device.

    - `cpu_batch_size`: batch size on a CPU, at which arrays stay in the processor's cache;
    - `gpu_batch_size`: smallest batch size on another device, which needs many batch elements.
    """
    if jax.default_backend() == "cpu":
        return cpu_batch_size
    return max(cpu_batch_size, gpu_batch_size)


def unbatch(function: BatchFunction) -> BatchFunction:
    """Return `function` as a function of one element, whose arrays have no batch axis.

    Under `jax.vmap` the returned function calls `function` once for the whole batch.
    """
    batched_function = custom_vmap(function)

    @batched_function.def_vmap
    @with_default_jax_settings
    def merge_vmapped_axis_into_lanes(
        axis_size: int, is_batched_by_argument: PyTree, *arrays: PyTree
    ) -> tuple:
        n_lanes = jax.tree.leaves(arrays)[0].shape[-1]

        def merge_axis_into_lanes(x: Array, is_batched: bool) -> Array:
            x = x if is_batched else jnp.broadcast_to(x, (axis_size, *x.shape))
            return jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], axis_size * n_lanes)

        def split_lanes(x: Array) -> Array:
            return jnp.moveaxis(x.reshape(*x.shape[:-1], axis_size, n_lanes), -2, 0)

        outputs_with_lanes_last = batched_function(
            *jax.tree.map(merge_axis_into_lanes, arrays, tuple(is_batched_by_argument))
        )
        return jax.tree.map(split_lanes, outputs_with_lanes_last), jax.tree.map(
            lambda _: True, outputs_with_lanes_last
        )

    def evaluate_one_element(*arrays: PyTree) -> PyTree:
        outputs = batched_function(*jax.tree.map(lambda x: jnp.asarray(x)[..., None], arrays))
        return jax.tree.map(lambda x: x[..., 0], outputs)

    return evaluate_one_element


def apply_function_in_blocks(function: BatchFunction, block_size: int) -> BatchFunction:
    """Return a function that applies `function` to `block_size` batch elements at a time.

    The arrays of a block stay in the processor's cache. A GPU takes larger blocks, of
    `GPU_BLOCK_SIZE` elements. The first array must have the batch axis. Scalars are the same
    for all elements.
    """
    block_size = choose_batch_size(block_size, GPU_BLOCK_SIZE)

    def evaluate_blockwise(*arrays: PyTree) -> PyTree:
        n_lanes = jax.tree.leaves(arrays)[0].shape[-1]
        if n_lanes <= block_size:
            return function(*arrays)
        arrays_with_lanes, scalars = eqx.partition(arrays, lambda x: jnp.ndim(x) > 0)

        def split_blocks(x: Array) -> Array:  # The last element pads the last block.
            n_padding_elements = -n_lanes % block_size
            padded_array = jnp.concatenate([x, jnp.repeat(x[..., -1:], n_padding_elements, -1)], -1)
            return jnp.moveaxis(padded_array.reshape(*x.shape[:-1], -1, block_size), -2, 0)

        def merge_blocks(x: Array) -> Array:
            return jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], -1)[..., :n_lanes]

        block_results = lax.map(
            lambda block: function(*eqx.combine(block, scalars)),
            jax.tree.map(split_blocks, arrays_with_lanes),
        )
        return jax.tree.map(merge_blocks, block_results)

    return evaluate_blockwise


def is_inside_jit() -> bool:
    """Return whether an enclosing `jax.jit` is tracing the current calls.

    In this case a nested jit would only trace the function once more, which is unnecessary under a
    derivative.
    """
    return isinstance(jnp.zeros(()), jax.core.Tracer)


def make_zeros_like_output(function: Callable[..., PyTree], *arguments: PyTree) -> PyTree:
    """Return zeros with the structure and shapes of the output of `function`, without calling
    it.
    """
    make_zero_leaf = lambda leaf: jnp.zeros(leaf.shape, leaf.dtype)
    return jax.tree.map(make_zero_leaf, jax.eval_shape(function, *arguments))


def select_tree_rows(tree: PyTree, row_indices: Any) -> PyTree:
    """Select elements along the leading axis of all arrays in a tree, and return NumPy arrays."""
    return jax.tree.map(lambda x: np.asarray(x)[row_indices], tree)


def select_rows_on_device(tree: PyTree, row_indices: Any) -> PyTree:
    """Select elements as `select_tree_rows` does, and return arrays on the device.

    NumPy selects the elements, because JAX would compile a program for each shape.
    """
    return jax.device_put(select_tree_rows(tree, row_indices))


def replace_rows(tree: PyTree, row_indices: np.ndarray, new_rows: PyTree) -> PyTree:
    """Return a tree of NumPy arrays in which some elements along the leading axis are replaced."""

    def replace_array_rows(array: Any, new_array_rows: Any) -> np.ndarray:
        array = np.array(array)
        array[row_indices] = new_array_rows
        return array

    return jax.tree.map(replace_array_rows, tree, new_rows)


def concatenate_tree_rows(*trees: PyTree) -> PyTree:
    """Concatenate trees of arrays along their leading axes, and return NumPy arrays."""
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *trees)


def map_in_batches(function: Callable, batch_sizes: tuple[int, ...], *trees: PyTree) -> PyTree:
    """Apply `function` to trees of arrays in batches along the leading axis, and join the results.

    Each batch is padded to the smallest size in `batch_sizes` that can contain it, so that the
    function is compiled once for each size. A larger batch costs less for each element, and a
    smaller one wastes less on padding. Inputs and outputs are JAX arrays.
    """
    if len(jax.tree.leaves(trees)[0]) in batch_sizes:
        return function(*jax.device_put(trees))
    call_with_device_arrays = lambda *batches_of_trees: function(*jax.device_put(batches_of_trees))
    return jax.device_put(map_in_numpy_batches(call_with_device_arrays, batch_sizes, *trees))


def map_in_numpy_batches(
    function: Callable, batch_sizes: tuple[int, ...], *trees: PyTree
) -> PyTree:
    """Apply a compiled function in batches as `map_in_batches` does, to NumPy arrays.

    The outputs are also NumPy arrays. For small batches, this function takes a fraction of the time
    of `map_in_batches`.
    """
    n_rows, batch_results = len(jax.tree.leaves(trees)[0]), []
    batch_start_row = 0
    while batch_start_row < n_rows:
        n_remaining_rows = n_rows - batch_start_row
        batch_size_index = bisect.bisect_left(batch_sizes[:-1], n_remaining_rows)
        batch_size = batch_sizes[batch_size_index]
        if batch_size_index > 0:
            smaller_batch_size = batch_sizes[batch_size_index - 1]
            # Several smaller batches replace a batch that would be at most half full.
            if -(-n_remaining_rows // smaller_batch_size) * smaller_batch_size <= batch_size // 2:
                batch_size = smaller_batch_size
        batch_end_row = min(batch_start_row + batch_size, n_rows)
        row_indices = np.minimum(
            np.arange(batch_start_row, batch_start_row + batch_size), n_rows - 1
        )
        batch_result = function(*select_tree_rows(trees, row_indices))
        batch_results.append(
            select_tree_rows(batch_result, slice(0, batch_end_row - batch_start_row))
        )
        batch_start_row = batch_end_row
    return concatenate_tree_rows(*batch_results) if len(batch_results) > 1 else batch_results[0]


MAX_SELECTED_ENTRIES = 64
"""Largest length of an axis that each lane indexes by itself, because every entry is read."""

PRIMITIVES_WITH_LEADING_AXES = frozenset(
    [
        "concatenate",
        "cumsum",
        "expand_dims",
        "optimization_barrier",
        "split",
        "squeeze",
        "stack",
        "unstack",
    ]
).union(COMBINING_PRIMITIVE_BY_REDUCTION)
"""Primitives whose parameters name axes, so that another axis at the end changes nothing."""


CALLING_PRIMITIVES = frozenset(["cond", "scan", "while", *CALLED_JAXPR_PARAMETERS])
"""Primitives that contain traces, in which further primitives may need a rule."""


class LaneValue(NamedTuple):
    """An array of a trace, and whether its last axis is that of the lanes."""

    array: Any
    has_lanes: bool


def append_lane_axis(function: Callable[..., Any], n_shared: int = 0) -> Callable[..., Any]:
    """Return a function of arrays with lanes on their last axis, from a function of one lane.

    The first `n_shared` arguments are arrays without lanes, the same for all lanes. All results
    have lanes.
    """

    def call_with_lanes(*arguments: Any) -> Any:
        argument_leaves, structure = jax.tree.flatten(arguments)
        n_shared_leaves = len(jax.tree.leaves(arguments[:n_shared]))
        n_lanes = argument_leaves[-1].shape[-1]
        values = [LaneValue(x, i >= n_shared_leaves) for i, x in enumerate(argument_leaves)]
        is_weak = lambda x: bool(getattr(jax.typeof(x), "weak_type", False))
        one_lane = [
            jax.ShapeDtypeStruct(
                x.shape[:-1] if has_lanes else jnp.shape(x), x.dtype, weak_type=is_weak(x)
            )
            for x, has_lanes in values
        ]
        closed_jaxpr, result_shapes = jax.make_jaxpr(function, return_shape=True)(
            *jax.tree.unflatten(structure, one_lane)
        )
        results = _evaluate(n_lanes, closed_jaxpr, values)
        return jax.tree.unflatten(
            jax.tree.structure(result_shapes), [_with_lanes(n_lanes, x) for x in results]
        )

    return call_with_lanes


def _with_lanes(n_lanes: int, value: LaneValue, shape: tuple[int, ...] | None = None) -> Any:
    """Return the array of a value with a lane axis, broadcast to `shape` and the lanes."""
    array, has_lanes = value
    own_shape = jnp.shape(array)[:-1] if has_lanes else jnp.shape(array)
    shape = own_shape if shape is None else shape
    if has_lanes and own_shape == shape:
        return array
    axes = (*range(len(own_shape)), *((len(shape),) if has_lanes else ()))
    return lax.broadcast_in_dim(array, (*shape, n_lanes), axes)


def _evaluate(
    n_lanes: int, closed_jaxpr: ClosedJaxpr, arguments: Sequence[LaneValue]
) -> list[LaneValue]:
    """Return the results of a trace of one lane for arguments of which some have lanes."""
    jaxpr = closed_jaxpr.jaxpr
    values = dict(zip(jaxpr.invars, arguments, strict=True))
    values |= {
        v: LaneValue(x, False) for v, x in zip(jaxpr.constvars, closed_jaxpr.consts, strict=True)
    }
    read = lambda atom: LaneValue(atom.val, False) if isinstance(atom, Literal) else values[atom]
    for equation in jaxpr.eqns:
        operands = [read(atom) for atom in equation.invars]
        name = equation.primitive.name
        if any(x.has_lanes for x in operands) or name in CALLING_PRIMITIVES:
            results = _evaluate_with_lanes(n_lanes, equation, operands)
        else:
            results = _bind(equation, [x.array for x in operands], False)
        values |= zip(equation.outvars, results, strict=True)
    return [read(atom) for atom in jaxpr.outvars]


def _bind(equation: Any, arrays: Sequence[Any], has_lanes: bool, **changed: Any) -> list[LaneValue]:
    """Return the results of the primitive of an equation, with some parameters changed."""
    results = equation.primitive.bind(*arrays, **equation.params | changed)
    if not equation.primitive.multiple_results:
        results = [results]
    return [LaneValue(x, has_lanes) for x in results]


def _evaluate_with_lanes(
    n_lanes: int, equation: Any, operands: Sequence[LaneValue]
) -> list[LaneValue]:
    name = equation.primitive.name
    if name in RULES:
        return RULES[name](n_lanes, equation, operands)
    if name in DECOMPOSITIONS and not (name in ELEMENTWISE_RULES and len(operands) <= 3):
        decomposed = jax.make_jaxpr(functools.partial(DECOMPOSITIONS[name], **equation.params))
        return _evaluate(n_lanes, decomposed(*(x.aval for x in equation.invars)), operands)
    if name in CALLED_JAXPR_PARAMETERS:
        closed_jaxpr = equation.params[CALLED_JAXPR_PARAMETERS[name]]
        flags = tuple(x.has_lanes for x in operands)
        if equation.params.get("name") != NOINLINE_FUNCTION_NAME or not any(flags):
            return _evaluate(n_lanes, closed_jaxpr, operands)
        evaluate_arrays, result_flags = _make_separate_function(n_lanes, closed_jaxpr, flags)
        return list(map(LaneValue, evaluate_arrays(*(x.array for x in operands)), result_flags))
    if name in ELEMENTWISE_RULES:
        shape = equation.outvars[0].aval.shape
        # Numbers that lanes share need no axes, except where operands have one shape.
        may_lack_lane_axis = name not in ("add_any", "select_n")
        is_number = lambda x: may_lack_lane_axis and not x.has_lanes and jnp.ndim(x.array) == 0
        arrays = [x.array if is_number(x) else _with_lanes(n_lanes, x, shape) for x in operands]
        return _bind(equation, arrays, True)
    if name in PRIMITIVES_WITH_LEADING_AXES:
        return _bind(equation, [_with_lanes(n_lanes, x) for x in operands], True)
    raise NotImplementedError(f"{name} has no rule for lanes")


@functools.lru_cache(64)
def _make_separate_function(
    n_lanes: int, closed_jaxpr: ClosedJaxpr, flags: tuple[bool, ...]
) -> tuple[Callable, tuple[bool, ...]]:
    """Return a function that is traced and compiled once for all calls of a trace with lanes.

    The second result says which of its results have lanes.
    """
    result_flags = _find_lanes(closed_jaxpr, flags)
    evaluate_arrays = lambda *arrays: _make_arrays(
        n_lanes, _evaluate(n_lanes, closed_jaxpr, list(map(LaneValue, arrays, flags))), result_flags
    )
    return mark_noinline(evaluate_arrays), result_flags


def _broadcast(n_lanes: int, equation: Any, operands: Sequence[LaneValue]) -> list[LaneValue]:
    shape, axes = (equation.params[x] for x in ("shape", "broadcast_dimensions"))
    changed = {"shape": (*shape, n_lanes), "broadcast_dimensions": (*axes, len(shape))}
    return _bind(equation, [operands[0].array], True, **changed)


def _transpose(n_lanes: int, equation: Any, operands: Sequence[LaneValue]) -> list[LaneValue]:
    order = equation.params["permutation"]
    return _bind(equation, [operands[0].array], True, permutation=(*order, len(order)))


def _pad(n_lanes: int, equation: Any, operands: Sequence[LaneValue]) -> list[LaneValue]:
    array, padding = operands
    if padding.has_lanes:
        raise NotImplementedError("pad by a value that differs between lanes has no rule")
    widths = (*equation.params["padding_config"], (0, 0, 0))
    return [LaneValue(lax.pad(array.array, padding.array, widths), True)]


def _slice(n_lanes: int, equation: Any, operands: Sequence[LaneValue]) -> list[LaneValue]:
    starts, limits, strides = (
        equation.params[x] for x in ("start_indices", "limit_indices", "strides")
    )
    strides = None if strides is None else (*strides, 1)
    array = lax.slice(operands[0].array, (*starts, 0), (*limits, n_lanes), strides)
    return [LaneValue(array, True)]


def _dynamic_slice(n_lanes: int, equation: Any, operands: Sequence[LaneValue]) -> list[LaneValue]:
    """Return a part of an array. Where lanes have indices of their own, each selects its entry."""
    (array, has_lanes), *indices = operands
    sizes = equation.params["slice_sizes"]
    for axis, ((index, varies), size) in enumerate(zip(indices, sizes, strict=True)):
        if not varies:
            array = lax.dynamic_slice_in_dim(array, index, size, axis)
            continue
        array, has_lanes = _with_lanes(n_lanes, LaneValue(array, has_lanes)), True
        parts = [
            lax.slice_in_dim(array, start, start + size, axis=axis)
            for start in range(_require_short(array.shape[axis]) - size + 1)
        ]
        last = len(parts) - 1
        select = lambda selected, i, index=index, parts=parts, last=last: jnp.where(
            jnp.clip(index, 0, last) == i, parts[i], selected
        )
        array = functools.reduce(select, range(1, len(parts)), parts[0])
    return [LaneValue(array, has_lanes)]


def _update_slice(n_lanes: int, equation: Any, operands: Sequence[LaneValue]) -> list[LaneValue]:
    """Return an array with a part replaced, at an index that may differ between lanes."""
    array, part, *indices = operands
    lane_array, lane_part = (_with_lanes(n_lanes, x) for x in (array, part))
    varying_axes = [axis for axis, index in enumerate(indices) if index.has_lanes]
    indices = [LaneValue(jnp.asarray(x, jnp.int32), flag) for x, flag in indices]
    lane_start = jnp.zeros((), jnp.int32)
    if not varying_axes:
        starts = [*(x.array for x in indices), lane_start]
        return [LaneValue(lax.dynamic_update_slice(lane_array, lane_part, starts), True)]
    last_starts = [
        _require_short(lane_array.shape[axis]) - lane_part.shape[axis] for axis in varying_axes
    ]
    result = lane_array
    clipped = [
        jnp.clip(indices[a].array, 0, n) for a, n in zip(varying_axes, last_starts, strict=True)
    ]
    for flat_start in range(math.prod(n + 1 for n in last_starts)):
        starts, is_here = [x.array for x in indices], jnp.ones(n_lanes, bool)
        for axis, last, index in zip(varying_axes, last_starts, clipped, strict=True):
            flat_start, starts[axis] = divmod(flat_start, last + 1)
            is_here &= index == starts[axis]
            starts[axis] = jnp.asarray(starts[axis], jnp.int32)
        updated = lax.dynamic_update_slice(lane_array, lane_part, [*starts, lane_start])
        result = jnp.where(is_here, updated, result)
    return [LaneValue(result, True)]


def _require_short(length: int) -> int:
    if length > MAX_SELECTED_ENTRIES:
        raise NotImplementedError(
            f"an index that differs between lanes reads an axis of {length}, at most "
            f"{MAX_SELECTED_ENTRIES} have a rule"
        )
    return length


@functools.lru_cache(maxsize=1024)
def _find_lanes(closed_jaxpr: ClosedJaxpr, argument_flags: tuple[bool, ...]) -> tuple[bool, ...]:
    """Return which results of a trace have lanes, if the arguments with a true flag have lanes."""
    jaxpr = closed_jaxpr.jaxpr
    flags = dict(zip(jaxpr.invars, argument_flags, strict=True))
    read = lambda atom: not isinstance(atom, Literal) and flags.get(atom, False)
    for equation in jaxpr.eqns:
        operands, name = tuple(map(read, equation.invars)), equation.primitive.name
        if name == "while":
            results = _find_lanes_of_while(equation.params, operands)
        elif name == "scan":
            n_constants, n_carry = count_scan_arguments(equation.params)
            results = _spread_lanes(equation.params["jaxpr"], operands, n_constants, n_carry)
        elif name in CALLED_JAXPR_PARAMETERS:
            results = _find_lanes(equation.params[CALLED_JAXPR_PARAMETERS[name]], operands)
        else:
            results = (any(operands),) * len(equation.outvars)
        flags |= zip(equation.outvars, results, strict=True)
    return tuple(map(read, jaxpr.outvars))


def _spread_lanes(
    body: ClosedJaxpr, flags: tuple[bool, ...], n_constants: int, n_carry: int
) -> tuple[bool, ...]:
    """Return which results of a loop's body have lanes, if carried arrays do in any iteration."""
    end = n_constants + n_carry
    while True:
        results = _find_lanes(body, flags)
        spread = *flags[:n_constants], *map(operator.or_, flags[n_constants:end], results)
        if spread == flags[:end]:
            return *flags[n_constants:end], *results[n_carry:]
        flags = *spread, *flags[end:]


def _find_lanes_of_while(params: Any, flags: tuple[bool, ...]) -> tuple[bool, ...]:
    """Return which arrays a loop carries have lanes: all, if lanes end at different iterations."""
    n_condition, n_body = params["cond_nconsts"], params["body_nconsts"]
    body_flags = flags[n_condition:]
    carry = _spread_lanes(params["body_jaxpr"], body_flags, n_body, len(body_flags) - n_body)
    varies = _find_lanes(params["cond_jaxpr"], (*flags[:n_condition], *carry))[0]
    return (True,) * len(carry) if varies else carry


def _make_arrays(n_lanes: int, values: Sequence[LaneValue], flags: Sequence[bool]) -> list[Any]:
    """Return the arrays of values, with a lane axis where the flag of a value is true."""
    return [
        _with_lanes(n_lanes, value) if flag else value.array
        for value, flag in zip(values, flags, strict=False)
    ]


def _while(n_lanes: int, equation: Any, operands: Sequence[LaneValue]) -> list[LaneValue]:
    """Return what a loop carries. If lanes end at different iterations, the others wait."""
    params = equation.params
    n_condition, n_body = params["cond_nconsts"], params["body_nconsts"]
    condition_constants = operands[:n_condition]
    body_constants = operands[n_condition : n_condition + n_body]
    carry = operands[n_condition + n_body :]
    flags = _find_lanes_of_while(params, tuple(x.has_lanes for x in operands))
    condition_flags = *(x.has_lanes for x in condition_constants), *flags
    (varies,) = _find_lanes(params["cond_jaxpr"], condition_flags)
    make_arrays = lambda values: _make_arrays(n_lanes, values, flags)
    make_values = lambda arrays: list(map(LaneValue, arrays, flags))

    def find_condition(arrays: Sequence[Any]) -> Any:
        values = [*condition_constants, *make_values(arrays)]
        (condition,) = _evaluate(n_lanes, params["cond_jaxpr"], values)
        return _with_lanes(n_lanes, condition) if varies else condition.array

    def find_next(arrays: Sequence[Any]) -> list[Any]:
        values = [*body_constants, *make_values(arrays)]
        return make_arrays(_evaluate(n_lanes, params["body_jaxpr"], values))

    start = make_arrays(carry)
    if not varies:
        return make_values(lax.while_loop(find_condition, find_next, start))

    def advance(state: tuple) -> tuple:
        is_running, arrays = state
        arrays = [
            jnp.where(is_running, new, old)
            for new, old in zip(find_next(arrays), arrays, strict=True)
        ]
        return find_condition(arrays), arrays

    initial_state = find_condition(start), start
    return make_values(lax.while_loop(lambda state: jnp.any(state[0]), advance, initial_state)[1])


def _scan(n_lanes: int, equation: Any, operands: Sequence[LaneValue]) -> list[LaneValue]:
    params = equation.params
    n_constants, n_carry = count_scan_arguments(params)
    constants, carry = operands[:n_constants], operands[n_constants : n_constants + n_carry]
    scanned = operands[n_constants + n_carry :]
    scanned_flags = [x.has_lanes for x in scanned]
    operand_flags = tuple(x.has_lanes for x in operands)
    flags = _spread_lanes(params["jaxpr"], operand_flags, n_constants, n_carry)

    def advance(arrays: list[Any], slices: list[Any]) -> tuple[list[Any], list[Any]]:
        values = [
            *constants,
            *map(LaneValue, arrays, flags),
            *map(LaneValue, slices, scanned_flags),
        ]
        results = _make_arrays(n_lanes, _evaluate(n_lanes, params["jaxpr"], values), flags)
        return results[:n_carry], results[n_carry:]

    final, stacked = lax.scan(
        advance,
        _make_arrays(n_lanes, carry, flags),
        [x.array for x in scanned],
        params["length"],
        params["reverse"],
    )
    return list(map(LaneValue, [*final, *stacked], flags))


def _choose_branch(n_lanes: int, equation: Any, operands: Sequence[LaneValue]) -> list[LaneValue]:
    """Return the results of the branch that each lane takes.

    A branch runs, for all lanes, if any lane takes it.
    """
    (index, _), *arguments = operands
    varies = any(x.has_lanes for x in operands)
    branches, lane_axis = equation.params["branches"], (n_lanes,) * varies
    index = jnp.clip(index.astype(int), 0, len(branches) - 1)
    results = [
        jnp.zeros((*variable.aval.shape, *lane_axis), variable.aval.dtype)
        for variable in equation.outvars
    ]
    for i, branch in enumerate(branches):

        def run_branch(state: tuple, i: int = i, branch: Any = branch) -> tuple:
            values = _evaluate(n_lanes, branch, arguments)
            arrays = [_with_lanes(n_lanes, x) if varies else x.array for x in values]
            selected = [jnp.where(index == i, a, b) for a, b in zip(arrays, state[1], strict=True)]
            return jnp.zeros((), bool), selected

        is_taken = jnp.any(index == i)
        _, results = lax.while_loop(lambda state: state[0], run_branch, (is_taken, results))
    return [LaneValue(x, varies) for x in results]


RULES: dict[str, Callable[[int, Any, Sequence[LaneValue]], list[LaneValue]]] = {
    "broadcast_in_dim": _broadcast,
    "cond": _choose_branch,
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _update_slice,
    "pad": _pad,
    "reshape": lambda n_lanes, equation, operands: [
        LaneValue(lax.reshape(operands[0].array, (*equation.params["new_sizes"], n_lanes)), True)
    ],
    "scan": _scan,
    "slice": _slice,
    "transpose": _transpose,
    "while": _while,
}
"""Rules of primitives whose parameters or operands change with the lane axis, by name."""
