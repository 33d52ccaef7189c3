"""Compiled functions of lanes on numpy arrays: machine code, or XLA programs for blocks of
lanes.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from vrw_jax import simd
from vrw_jax.numerics import batch_sizes
from vrw_jax.runtime import cached_lane_program

STRAGGLER_DIVISOR = 8
"""Inverse fraction of running lanes below which an XLA program stops. The remaining lanes of all
blocks are run again together. The value is chosen because a block with fewer running lanes wastes
most of its work."""

_program_cache: dict[Any, Callable] = {}
"""Compiled steps by all settings on which they depend, see `run_compiled`."""


def run_compiled(
    lane_step: Callable[..., tuple],
    lane_independent_values: list[np.ndarray],
    lane_arrays: list[np.ndarray],
    cache_key: Any,
    register_limits: simd.RegisterLimits = simd.DEFAULT_LIMITS,
) -> list[np.ndarray]:
    """Return the results of `lane_step(lane_independent, lanes, straggler_count)`, compiled.

    The first result of `lane_step` marks unfinished lanes.

    - `cache_key`: all settings on which `lane_step` depends, except its arguments.
    """
    dtype, uses_machine_code = lane_arrays[0].dtype, simd.is_available()
    block_size = batch_sizes.XLA_LANE_BATCH_SIZE
    program_key = (cache_key, dtype, uses_machine_code, block_size)
    if program_key not in _program_cache:
        if uses_machine_code:
            lane_independent_dtypes = [x.dtype for x in lane_independent_values]
            _program_cache[program_key] = cached_lane_program(
                lane_step,
                lane_independent_dtypes,
                len(lane_arrays),
                dtype,
                cache_key,
                register_limits,
            )
        else:
            _program_cache[program_key] = functools.partial(
                _run_xla_blocks, jax.jit(lane_step), block_size
            )
    return _program_cache[program_key](lane_independent_values, lane_arrays)


def _run_xla_blocks(
    program: Callable,
    block_size: int,
    lane_independent_values: list[np.ndarray],
    lane_arrays: list[np.ndarray],
) -> list[np.ndarray]:
    """Return the results of a program that is run block by block.

    Stragglers of all blocks are run again together.
    """
    result_arrays: list[np.ndarray] = []
    unfinished_lanes = np.arange(len(lane_arrays[0]))
    while len(unfinished_lanes) > 0:
        is_last_round = len(unfinished_lanes) <= block_size
        straggler_count = np.int32(0 if is_last_round else block_size // STRAGGLER_DIVISOR)
        straggler_lanes = []
        for block_start in range(0, len(unfinished_lanes), block_size):
            block_lanes = unfinished_lanes[block_start : block_start + block_size]
            padded_lanes = np.concatenate(
                [block_lanes, np.repeat(block_lanes[-1:], block_size - len(block_lanes))]
            )
            block_arrays = tuple(x[padded_lanes] for x in lane_arrays)
            block_outputs = [
                np.asarray(x)[..., : len(block_lanes)]
                for x in program(tuple(lane_independent_values), block_arrays, straggler_count)
            ]
            result_arrays = result_arrays or [
                np.empty((*x.shape[:-1], len(lane_arrays[0])), x.dtype) for x in block_outputs
            ]
            for result_array, block_result in zip(result_arrays, block_outputs, strict=True):
                result_array[..., block_lanes[~block_outputs[0]]] = block_result[
                    ..., ~block_outputs[0]
                ]
            straggler_lanes.append(block_lanes[block_outputs[0]])
        unfinished_lanes = np.concatenate(straggler_lanes)
    return result_arrays
