"""Functions of lanes, compiled and run on numpy arrays: as machine code, or in blocks by XLA."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from vrw_jax import simd
from vrw_jax.runtime import lane_program

BLOCK = 32_768
"""Number of lanes of a block that XLA runs side by side, as on a GPU."""
FEW = 8
"""A block stops early once less than one in `STRAGGLER_DIVISOR` of its lanes is running."""

_programs: dict[Any, Callable] = {}
"""Compiled steps by all that they depend on, see `run_compiled`."""


def run_lanes(
    step: Callable[..., tuple],
    uniform: list[np.ndarray],
    lanes: list[np.ndarray],
    settings: Any,
    small: int = simd.SMALL,
) -> list[np.ndarray]:
    """Compile and run `step(uniform, lanes, few)`. Its first result marks the lanes that are
    unfinished.

    `cache_key` contains all that `step` depends on except its arguments.
    """
    dtype, cpu = lanes[0].dtype, simd.serves()
    key = (settings, dtype, cpu, BLOCK)
    if key not in _programs:
        if cpu:
            kinds = [x.dtype for x in uniform]
            _programs[key] = lane_program(step, kinds, len(lanes), dtype, settings, small)
        else:
            _programs[key] = functools.partial(_by_xla, jax.jit(step))
    return _programs[key](uniform, lanes)


def _by_xla(
    program: Callable, uniform: list[np.ndarray], lanes: list[np.ndarray]
) -> list[np.ndarray]:
    """Run the program block by block; stragglers are run again together."""
    told: list[np.ndarray] = []
    open_ = np.arange(len(lanes[0]))
    while len(open_) > 0:
        few = np.int32(BLOCK // FEW if len(open_) > BLOCK else 0)
        late = []
        for begin in range(0, len(open_), BLOCK):
            some = open_[begin : begin + BLOCK]
            filled = np.concatenate([some, np.repeat(some[-1:], BLOCK - len(some))])
            given = tuple(x[filled] for x in lanes)
            out = [np.asarray(x)[..., : len(some)] for x in program(tuple(uniform), given, few)]
            told = told or [np.empty((*x.shape[:-1], len(lanes[0])), x.dtype) for x in out]
            for told_whole, part in zip(told, out, strict=True):
                told_whole[..., some[~out[0]]] = part[..., ~out[0]]
            late.append(some[out[0]])
        open_ = np.concatenate(late)
    return told
