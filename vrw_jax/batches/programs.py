"""Functions of lanes, compiled and run on numpy arrays: as machine code, or in blocks by XLA."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from vrw_jax import simd
from vrw_jax.runtime import cached_lane_program

N_LANES_PER_BLOCK = 32_768
"""Number of lanes of a block that XLA runs side by side, as on a GPU."""
STRAGGLER_DIVISOR = 8
"""A block stops early once less than one in `STRAGGLER_DIVISOR` of its lanes is running."""

_program_cache: dict[Any, Callable] = {}
"""Compiled steps by all that they depend on, see `run_compiled`."""


def run_compiled(
    step: Callable[..., tuple],
    uniform_values: list[np.ndarray],
    lane_arrays: list[np.ndarray],
    cache_key: Any,
    max_group_size: int = simd.MAX_UNROLLED,
) -> list[np.ndarray]:
    """Compile and run `step(uniform, lanes, few)`. Its first result marks the lanes that are
    unfinished.

    `cache_key` contains all that `step` depends on except its arguments.
    """
    dtype, uses_machine_code = lane_arrays[0].dtype, simd.is_available()
    program_key = (cache_key, dtype, uses_machine_code, N_LANES_PER_BLOCK)
    if program_key not in _program_cache:
        if uses_machine_code:
            uniform_dtypes = [x.dtype for x in uniform_values]
            _program_cache[program_key] = cached_lane_program(
                step, uniform_dtypes, len(lane_arrays), dtype, cache_key, max_group_size
            )
        else:
            _program_cache[program_key] = functools.partial(_run_xla_blocks, jax.jit(step))
    return _program_cache[program_key](uniform_values, lane_arrays)


def _run_xla_blocks(
    program: Callable, uniform_values: list[np.ndarray], lane_arrays: list[np.ndarray]
) -> list[np.ndarray]:
    """Run the program block by block; stragglers are run again together."""
    results: list[np.ndarray] = []
    unfinished = np.arange(len(lane_arrays[0]))
    while len(unfinished) > 0:
        straggler_count = np.int32(
            N_LANES_PER_BLOCK // STRAGGLER_DIVISOR if len(unfinished) > N_LANES_PER_BLOCK else 0
        )
        stragglers = []
        for block_start in range(0, len(unfinished), N_LANES_PER_BLOCK):
            block = unfinished[block_start : block_start + N_LANES_PER_BLOCK]
            padded_block = np.concatenate(
                [block, np.repeat(block[-1:], N_LANES_PER_BLOCK - len(block))]
            )
            block_arrays = tuple(x[padded_block] for x in lane_arrays)
            outputs = [
                np.asarray(x)[..., : len(block)]
                for x in program(tuple(uniform_values), block_arrays, straggler_count)
            ]
            results = results or [
                np.empty((*x.shape[:-1], len(lane_arrays[0])), x.dtype) for x in outputs
            ]
            for result, block_result in zip(results, outputs, strict=True):
                result[..., block[~outputs[0]]] = block_result[..., ~outputs[0]]
            stragglers.append(block[outputs[0]])
        unfinished = np.concatenate(stragglers)
    return results
