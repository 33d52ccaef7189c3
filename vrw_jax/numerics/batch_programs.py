"""Compiled functions over lanes that take NumPy arrays: machine code, or XLA programs for blocks of
lanes.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from vrw_jax import simd
from vrw_jax.numerics.cached_programs import compile_cached_lane_program
from vrw_jax.runtime import disk_cache as store

STRAGGLER_COUNT_DIVISOR = 8
"""Ratio of the block size to the number of unfinished lanes at which an XLA program stops.

The program then runs again for the unfinished lanes of all blocks together. The value is chosen
because a block with fewer unfinished lanes wastes most of its work.
"""

BatchProgram = Callable[[Sequence[Any], Sequence[np.ndarray]], list[np.ndarray]]
"""Compiled function of scalars, which are the same for all lanes, and of one array per input."""

_compiled_batch_programs: dict[Any, BatchProgram] = {}
"""Compiled functions over lanes, by all settings on which their traces depend."""


def compile_batch_program(
    lane_function: Callable[..., tuple],
    scalar_dtypes: Sequence[np.dtype],
    n_lane_arrays: int,
    lane_dtype: np.dtype,
    trace_key_settings: Any,
    xla_block_size: int,
    register_limits: simd.RegisterLimits = simd.DEFAULT_REGISTER_LIMITS,
    can_leave_lanes_unfinished: bool = False,
) -> BatchProgram:
    """Compile `lane_function(scalars, lanes)` to machine code, or with XLA if machine code is not
    available.

    A process compiles each function once. The arguments are those of `simd.compile_lane_program`,
    and:

    - `trace_key_settings`: all settings on which `lane_function` depends, besides its arguments;
    - `xla_block_size`: number of lanes that one call of an XLA program computes;
    - `can_leave_lanes_unfinished`: whether an XLA program may stop while a few lanes are
      unfinished. The function then takes the number of these lanes as a third argument, and its
      first result is a boolean array that marks them.
    """
    uses_machine_code = simd.is_machine_code_available()
    program_signature = tuple(scalar_dtypes), n_lane_arrays, lane_dtype
    # With jax_enable_x64 off, for example, the program converts lanes of float64 to float32.
    trace_environment = store.describe_trace_environment()
    program_key = (
        trace_key_settings,
        program_signature,
        uses_machine_code,
        xla_block_size,
        trace_environment,
    )
    batch_program = _compiled_batch_programs.get(program_key)  # one hash of a large key
    if batch_program is None:
        batch_program = (
            compile_cached_lane_program(
                lane_function, *program_signature, trace_key_settings, register_limits
            )
            if uses_machine_code
            else functools.partial(
                _run_xla_program_by_blocks,
                jax.jit(lane_function),
                xla_block_size,
                can_leave_lanes_unfinished,
            )
        )
        _compiled_batch_programs[program_key] = batch_program
    return batch_program


def _run_xla_program_by_blocks(
    xla_program: Callable,
    block_size: int,
    can_leave_lanes_unfinished: bool,
    scalar_arguments: Sequence[Any],
    lane_arrays: Sequence[np.ndarray],
) -> list[np.ndarray]:
    """Return the results of an XLA program that runs for one block of `block_size` lanes after
    another.

    The program then runs again for the unfinished lanes of all blocks together.
    """
    if len(lane_arrays[0]) == 0:
        output_shapes = jax.eval_shape(
            xla_program,
            tuple(scalar_arguments),
            tuple(jax.ShapeDtypeStruct((block_size,), x.dtype) for x in lane_arrays),
            *[np.int32(0)] * can_leave_lanes_unfinished,
        )
        return [np.empty((*x.shape[:-1], 0), x.dtype) for x in output_shapes]
    result_arrays: list[np.ndarray] = []
    unfinished_lane_indices = np.arange(len(lane_arrays[0]))
    while len(unfinished_lane_indices) > 0:
        is_last_round = len(unfinished_lane_indices) <= block_size
        straggler_count = np.int32(0 if is_last_round else block_size // STRAGGLER_COUNT_DIVISOR)
        straggler_lane_indices = []
        for block_start in range(0, len(unfinished_lane_indices), block_size):
            block_lane_indices = unfinished_lane_indices[block_start : block_start + block_size]
            n_lanes = len(block_lane_indices)
            padded_lane_indices = np.pad(block_lane_indices, (0, block_size - n_lanes), "edge")
            padded_outputs = xla_program(
                tuple(scalar_arguments),
                tuple(x[padded_lane_indices] for x in lane_arrays),
                *[straggler_count] * can_leave_lanes_unfinished,
            )
            block_outputs = [np.asarray(x)[..., :n_lanes] for x in padded_outputs]
            result_arrays = result_arrays or [
                np.empty((*x.shape[:-1], len(lane_arrays[0])), x.dtype) for x in block_outputs
            ]
            is_lane_finished = (
                ~block_outputs[0] if can_leave_lanes_unfinished else np.ones(n_lanes, bool)
            )
            for result_array, block_output in zip(result_arrays, block_outputs, strict=True):
                result_array[..., block_lane_indices[is_lane_finished]] = block_output[
                    ..., is_lane_finished
                ]
            straggler_lane_indices.append(block_lane_indices[~is_lane_finished])
        unfinished_lane_indices = np.concatenate(straggler_lane_indices)
    return result_arrays
