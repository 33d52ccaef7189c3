"""Conversion between functions of a batch and functions of one element.

Batches are on the last axis. Code with independent wheels on the last axis runs several times
faster than the same code for one wheel under `jax.vmap`. `unbatch` merges every `vmap`, including
nested ones, into the last axis.
"""

import bisect
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, PyTree

from vrw_jax.lanes.settings import with_default_jax_settings

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

    Each batch is padded to a size in `batch_sizes`, so that the function is compiled for few shapes
    only. Inputs and outputs are JAX arrays.
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
