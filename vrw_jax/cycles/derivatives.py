"""Derivatives of limit cycles by the implicit function theorem, to any order and in any mode.

First derivatives are the tangents of the linearized pass at the cycle. Second derivatives are
derivatives of that pass, of its tangents and of the monodromy matrix. They are taken along the
tangents of the cycle, one parameter after another. Both are machine code on a CPU.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax import simd
from vrw_jax.cycles.search import (
    Located,
    Parameters,
    Problem,
    columns_of,
    in_stages,
    name_for_export,
    search_lanes,
)
from vrw_jax.models import scales
from vrw_jax.numerics import (
    InForm,
    LaneFunction,
    in_blocks,
    on_branch,
    one_wheel,
    push,
    slopes_on_branch,
    without_derivative,
)
from vrw_jax.runtime import lane_function, remembered
from vrw_jax.wheel import PARAMETER_NAMES


def _tangent_space(problem: Problem, parameters: Parameters, located: Located) -> Located:
    """Return d(state) / d(parameters) over lanes, with a leading axis; zero where nothing was
    found."""
    passed = problem.pass_at(parameters, located, tuple(range(parameters.shape[0])))
    return _where_found(located, columns_of(passed, located))


def _monodromy(problem: Problem, parameters: Parameters, located: Located) -> Array:
    return _where_found(located, problem.pass_at(parameters, located).monodromy)


def _slopes_of_monodromy(
    problem: Problem, parameters: Parameters, known: tuple[Located, Located]
) -> Array:
    """Return d(monodromy) / d(parameters) along the branch, with a leading axis.

    `solution_and_tangents` are z and dz/dp. The directions are computed one after another, which
    keeps the compiled code as short as for one. Three of the nine follow from units. For the unit
    of mass, both masses grow in this direction. The forces of the ground and of the legs do not
    contain it.
    """
    located, columns = known
    hub, leg = (PARAMETER_NAMES.index(name) for name in ("hub_mass", "leg_mass"))
    whole = parameters[hub] + parameters[leg]
    of_hub, of_leg = parameters[hub] / whole, parameters[leg] / whole
    plain = [i for i in range(len(parameters)) if i not in (hub, leg, *scales.SCALES)]
    one, none = jnp.ones_like(whole), jnp.zeros_like(whole)
    first, second = jnp.asarray([*plain, leg]), jnp.asarray([*plain, hub])
    shares = jnp.stack([one] * len(plain) + [of_hub]), jnp.stack([none] * len(plain) + [-of_leg])
    unit = jnp.eye(len(parameters), dtype=parameters.dtype)[..., None]
    units = jnp.broadcast_to(unit, (len(parameters), *parameters.shape))

    def along(way: tuple) -> tuple[Array, Array]:
        i, j, a, b = way
        at = lambda x, i: lax.dynamic_index_in_dim(x, i, keepdims=False)
        way = jax.tree.map(lambda x: a * at(x, i) + b * at(x, j), (units, columns))
        return jax.jvp(functools.partial(_monodromy, problem), (parameters, located), way)

    matrices, turns = lax.map(along, (first, second, *shares))
    by = dict(zip(plain, turns[:-1], strict=True))
    grown = scales.MASS.left(jnp.zeros_like(turns[0]), tuple(parameters), by) / whole
    length = of_hub * of_hub + of_leg * of_leg
    by[hub] = (of_hub * grown - of_leg * turns[-1]) / length
    by[leg] = (of_leg * grown + of_hub * turns[-1]) / length
    rates = jnp.asarray([[0, 1], [-1, 0]])[..., None] * matrices[0]  # of angle and rate
    told = {
        i: rates if scale is scales.TIME else jnp.zeros_like(rates)
        for i, scale in scales.SCALES.items()
    }
    by = scales.with_scales(tuple(parameters), by, told)
    return jnp.stack([by[i] for i in range(len(parameters))])


def _where_found(located: Located, tree: Any) -> Any:
    """Return the tree with zeros in the lanes without a cycle."""
    return jax.tree.map(lambda x: jnp.where(located.found > 0.5, x, 0.0), tree)


def over_lanes(function: LaneFunction, like: Callable, settings: tuple, block: int) -> LaneFunction:
    """Return a batched function in its fastest form: machine code on a CPU, else XLA in blocks."""
    if simd.serves():
        return lane_function(function, like, settings)
    name_for_export()
    return remembered(in_blocks(function, block), settings)


def _in_form(name: str, likes: tuple[Callable, ...], problem: Problem) -> InForm:
    """Return a compiler for the first derivatives (`compile_batched`, one output template each).
    XLA compiles higher ones."""
    block = problem.options.block

    def in_form(function: LaneFunction, order: int) -> LaneFunction:
        if order < len(likes):
            return over_lanes(function, likes[order], (name, order, problem), block)
        return in_blocks(function, block)

    return in_form


def _columns_of(problem: Problem) -> Callable:
    """Return `_collocation_tangents` of one wheel as a differentiable function."""
    likes = (lambda parameters, located: located), (lambda parameters, known: known[0])
    form = _in_form("columns", likes, problem)
    columns = on_branch(functools.partial(_tangent_space, problem), lambda *at: columns(*at), form)
    return columns


def solve_cycle(
    problem: Problem, parameters: Array, guess: Located | None
) -> tuple[Located, tuple]:
    """Search for the cycle of one wheel, differentiable in its parameters. The guess has no
    derivative."""
    search = functools.partial(search_lanes, problem)
    like = lambda parameters, now, *_: now
    lanes = over_lanes(search, like, ("search", problem), problem.options.block)
    find = one_wheel(functools.partial(in_stages, problem, lanes))
    columns_of = _columns_of(problem)

    @jax.custom_jvp
    def solve(parameters: Array, *guess: Located) -> tuple[Located, tuple]:
        located, *other = find(parameters, *guess)
        return located, tuple(other)

    @solve.defjvp
    def rule(primals: tuple, tangents: tuple) -> tuple:
        located, other = solve(*primals)
        moved = push(columns_of(primals[0], located), tangents[0])
        return (located, other), (moved, without_derivative(other))

    return solve(parameters, *(() if guess is None else (guess,)))


def attach_monodromy(problem: Problem, matrix: Array, parameters: Array, located: Located) -> Array:
    """Return `monodromy_value` with the derivative of the monodromy matrix along the branch."""
    alike = lambda parameters, known: parameters
    form = _in_form("monodromy", (alike, alike), problem)
    matrix_of = functools.partial(_monodromy, problem)
    along = functools.partial(_slopes_of_monodromy, problem)
    slopes_of = slopes_on_branch(matrix_of, _columns_of(problem), form, along=along)

    @jax.custom_jvp
    def attach(matrix: Array, parameters: Array, located: Located) -> Array:
        return matrix

    @attach.defjvp
    def rule(primals: tuple, tangents: tuple) -> tuple:
        return attach(*primals), push(slopes_of(*primals[1:]), tangents[1])

    return attach(matrix, parameters, located)
