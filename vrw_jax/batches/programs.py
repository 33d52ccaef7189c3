"""A function of lanes, compiled and run for numpy's arrays: machine code, or blocks by XLA."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from vrw_jax import simd
from vrw_jax.runtime import lane_program

BLOCK = 32_768
"""Lanes that march side by side where XLA compiles them, as on a GPU."""
FEW = 8
"""A block waits no longer than usual once less than one in `FEW` of its lanes is running."""

_programs: dict[Any, Callable] = {}
"""Compiled steps by what they depend on, see `run_lanes`."""


def run_lanes(
    step: Callable[..., tuple],
    uniform: list[np.ndarray],
    lanes: list[np.ndarray],
    settings: Any,
    small: int = simd.SMALL,
) -> list[np.ndarray]:
    """`step(uniform, lanes, few)` compiled and run; its first result: lanes that it left undone.

    `settings`: all that `step` depends on but its arguments.
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
    """Block by block; late lanes run again among their like."""
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
