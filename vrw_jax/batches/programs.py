"""Compiled functions of lanes on numpy arrays: machine code, or programs of XLA in blocks."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from vrw_jax import simd
from vrw_jax.numerics import batch_sizes
from vrw_jax.runtime import cached_lane_program

STRAGGLER_DIVISOR = 8
"""Inverse share of running lanes below which a block by XLA stops; the rest is run again together.
It is chosen because a block with fewer running lanes wastes most of its work."""

_program_cache: dict[Any, Callable] = {}
"""Compiled steps by everything that they depend on, see `run_compiled`."""


def run_compiled(
    step: Callable[..., tuple],
    uniform_values: list[np.ndarray],
    lane_arrays: list[np.ndarray],
    cache_key: Any,
    limits: simd.RegisterLimits = simd.DEFAULT_LIMITS,
) -> list[np.ndarray]:
    """Compile and run `step(uniform, lanes, straggler_count)`, whose first result marks unfinished
    lanes, and return its results.

    `cache_key` contains all that `step` depends on except its arguments.
    """
    dtype, uses_machine_code = lane_arrays[0].dtype, simd.is_available()
    block_size = batch_sizes.XLA_LANE_BATCH_SIZE
    program_key = (cache_key, dtype, uses_machine_code, block_size)
    if program_key not in _program_cache:
        if uses_machine_code:
            uniform_dtypes = [x.dtype for x in uniform_values]
            _program_cache[program_key] = cached_lane_program(
                step, uniform_dtypes, len(lane_arrays), dtype, cache_key, limits
            )
        else:
            _program_cache[program_key] = functools.partial(
                _run_xla_blocks, jax.jit(step), block_size
            )
    return _program_cache[program_key](uniform_values, lane_arrays)


def _run_xla_blocks(
    program: Callable,
    block_size: int,
    uniform_values: list[np.ndarray],
    lane_arrays: list[np.ndarray],
) -> list[np.ndarray]:
    """Return the results of a program that is run block by block, with stragglers run again
    together.
    """
    results: list[np.ndarray] = []
    unfinished = np.arange(len(lane_arrays[0]))
    while len(unfinished) > 0:
        is_last_round = len(unfinished) <= block_size
        straggler_count = np.int32(0 if is_last_round else block_size // STRAGGLER_DIVISOR)
        stragglers = []
        for block_start in range(0, len(unfinished), block_size):
            block = unfinished[block_start : block_start + block_size]
            padded_block = np.concatenate([block, np.repeat(block[-1:], block_size - len(block))])
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
