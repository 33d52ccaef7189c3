"""Compiled functions over lanes that take NumPy arrays: machine code, or XLA programs for blocks of
lanes.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from vrw_jax import simd
from vrw_jax.numerics import batch_sizes
from vrw_jax.runtime import compile_cached_lane_program

STRAGGLER_COUNT_DIVISOR = 8
"""Ratio of the block size to the number of unfinished lanes at which an XLA program stops.

The program then runs again for the unfinished lanes of all blocks together. The value is chosen
because a block with fewer unfinished lanes wastes most of its work.
"""

_compiled_lane_programs: dict[Any, Callable] = {}
"""Compiled functions over lanes, by all settings on which their traces depend."""


def run_compiled_lane_function(
    lane_function: Callable[..., tuple],
    scalar_arguments: list[np.ndarray],
    lane_arrays: list[np.ndarray],
    cache_key: Any,
    register_limits: simd.RegisterLimits = simd.DEFAULT_REGISTER_LIMITS,
) -> list[np.ndarray]:
    """Return the results of `lane_function(scalars, lanes, straggler_count)`, computed by compiled
    code.

    The first result of `lane_function` must be a boolean array that marks unfinished lanes.

    - `cache_key`: all settings on which `lane_function` depends, besides its arguments.
    """
    lane_dtype, uses_machine_code = lane_arrays[0].dtype, simd.is_machine_code_available()
    block_size = batch_sizes.XLA_LANE_BATCH_SIZE
    program_key = (cache_key, lane_dtype, uses_machine_code, block_size)
    if program_key not in _compiled_lane_programs:
        if uses_machine_code:
            scalar_dtypes = [x.dtype for x in scalar_arguments]
            _compiled_lane_programs[program_key] = compile_cached_lane_program(
                lane_function,
                scalar_dtypes,
                len(lane_arrays),
                lane_dtype,
                cache_key,
                register_limits,
            )
        else:
            _compiled_lane_programs[program_key] = functools.partial(
                _run_xla_program_by_blocks, jax.jit(lane_function), block_size
            )
    return _compiled_lane_programs[program_key](scalar_arguments, lane_arrays)


def _run_xla_program_by_blocks(
    xla_program: Callable,
    block_size: int,
    scalar_arguments: list[np.ndarray],
    lane_arrays: list[np.ndarray],
) -> list[np.ndarray]:
    """Return the results of an XLA program that runs for one block of `block_size` lanes after
    another.

    The program then runs again for the unfinished lanes of all blocks together.
    """
    result_arrays: list[np.ndarray] = []
    unfinished_lanes = np.arange(len(lane_arrays[0]))
    while len(unfinished_lanes) > 0:
        is_last_round = len(unfinished_lanes) <= block_size
        straggler_count = np.int32(0 if is_last_round else block_size // STRAGGLER_COUNT_DIVISOR)
        straggler_lanes = []
        for block_start in range(0, len(unfinished_lanes), block_size):
            block_lanes = unfinished_lanes[block_start : block_start + block_size]
            padded_lanes = np.concatenate(
                [block_lanes, np.repeat(block_lanes[-1:], block_size - len(block_lanes))]
            )
            block_arrays = tuple(x[padded_lanes] for x in lane_arrays)
            block_outputs = [
                np.asarray(x)[..., : len(block_lanes)]
                for x in xla_program(tuple(scalar_arguments), block_arrays, straggler_count)
            ]
            result_arrays = result_arrays or [
                np.empty((*x.shape[:-1], len(lane_arrays[0])), x.dtype) for x in block_outputs
            ]
            for result_array, block_output in zip(result_arrays, block_outputs, strict=True):
                result_array[..., block_lanes[~block_outputs[0]]] = block_output[
                    ..., ~block_outputs[0]
                ]
            straggler_lanes.append(block_lanes[block_outputs[0]])
        unfinished_lanes = np.concatenate(straggler_lanes)
    return result_arrays
