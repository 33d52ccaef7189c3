"""Derivatives of limit cycles: by the implicit function theorem, to any order and in any mode.

First derivatives are the columns of the linearised pass at the cycle. Second ones (of the monodromy
matrix, of the columns themselves) come by complex step: the same pass with a parameter moved by
i h, whose imaginary parts over h are derivatives to rounding, since nothing is subtracted. It
compiles in the time of a pass, where a program of tangents takes three times that.
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
    name_for_export,
    not_searched,
    search_lanes,
)
from vrw_jax.numerics import (
    Linearised,
    Solution,
    in_blocks,
    on_branch,
    one_wheel,
    push,
    without_derivative,
)
from vrw_jax.runtime import lane_function, remembered


def _tangent_space(problem: Problem, parameters: Parameters, located: Located) -> Located:
    """d located / d parameters over lanes, with a leading axis; zero where nothing was found."""
    passed = problem.pass_at(parameters, located, tuple(range(parameters.shape[0])))
    return _where_found(located, columns_of(passed, located))


def _along_branch(
    problem: Problem, parameters: Parameters, located: Located, wanted: tuple[int, ...] = ()
) -> Linearised:
    """Derivatives of all that a pass finds by each parameter (leading axis), the cycle following.

    Newton's map z + correction has the slope dz/dp at a solution z, whatever z moved along. So the
    first of two passes, z standing still, finds how z moves, and the second goes along.
    """
    n, lanes = parameters.shape
    step = jnp.finfo(parameters.dtype).eps ** 2  # its square is lost beside 1

    def beside(x: Array, dx: Array) -> Array:
        """The directions as further lanes."""
        moved = x[..., None, :] + 1j * step * jnp.moveaxis(dx, 0, -2)
        return moved.reshape(*x.shape[:-1], n * lanes)

    def slope(x: Array) -> Array:
        return jnp.moveaxis((x.imag / step).reshape(*x.shape[:-1], n, lanes), -2, 0)

    units = jnp.broadcast_to(jnp.eye(n, dtype=parameters.dtype)[:, :, None], (n, n, lanes))
    moved_parameters = beside(parameters, units)
    standing = jax.tree.map(lambda x: jnp.zeros((n, *x.shape), x.dtype), located.solution)
    happens = jnp.tile(located.happens, n)

    def along(slopes: Solution) -> Linearised:
        solution = jax.tree.map(beside, located.solution, slopes)
        there = located._replace(solution=solution, happens=happens)
        return jax.tree.map(slope, problem.pass_at(moved_parameters, there, wanted))

    def again(_: Array, now: Linearised) -> Linearised:
        found = along(now.correction)
        return found._replace(correction=jax.tree.map(jnp.add, now.correction, found.correction))

    start = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(along, standing))
    return lax.fori_loop(0, 2, again, start)


def _where_found(located: Located, tree: Any) -> Any:
    """Zeros in the lanes without a cycle."""
    return jax.tree.map(lambda x: jnp.where(located.found > 0.5, x, 0.0), tree)


def _curvature(problem: Problem, parameters: Parameters, located: Located) -> Located:
    """Derivatives of `_tangent_space`, with one more leading axis."""
    passed = _along_branch(problem, parameters, located, tuple(range(parameters.shape[0])))
    return _where_found(located, jax.vmap(columns_of, in_axes=(0, None))(passed, located))


def _monodromy_slopes(problem: Problem, parameters: Parameters, located: Located) -> Array:
    """Derivatives of the monodromy matrix by each parameter, with a leading axis."""
    return _where_found(located, _along_branch(problem, parameters, located).monodromy)


def _over_lanes(function: Callable, like: Callable, problem: Problem, blocked: bool) -> Callable:
    """A function of the problem over lanes, in its quickest form: machine code on a CPU."""
    settings = (function.__name__, problem)
    of_problem = functools.partial(function, problem)
    if simd.serves():
        return lane_function(of_problem, functools.partial(like, problem), settings)
    name_for_export()
    return remembered(
        in_blocks(of_problem, problem.options.block) if blocked else of_problem, settings
    )


def solve_cycle(
    problem: Problem, parameters: Array, guess: Located | None
) -> tuple[Located, tuple]:
    """Search for one wheel, differentiable in its parameters; the guess has no derivative."""
    nothing = lambda problem, parameters, *_: not_searched(problem, parameters)
    alike = lambda problem, parameters, located: located
    find = one_wheel(_over_lanes(search_lanes, nothing, problem, blocked=False))
    columns_at = one_wheel(_over_lanes(_tangent_space, alike, problem, blocked=True))
    start = () if guess is None else (guess,)

    @jax.custom_jvp
    def solve(parameters: Array, *guess: Located) -> tuple[Located, tuple]:
        located, *other = find(parameters, *guess)
        return located, tuple(other)

    @jax.custom_jvp
    def solve_with_columns(parameters: Array, *guess: Located) -> tuple:
        located, *other = find(parameters, *guess)
        return located, tuple(other), columns_at(parameters, located)

    @solve.defjvp
    def rule(primals: tuple, tangents: tuple) -> tuple:
        located, other, columns = solve_with_columns(*primals)
        return (located, other), (push(columns, tangents[0]), without_derivative(other))

    @solve_with_columns.defjvp
    def second_rule(primals: tuple, tangents: tuple) -> tuple:
        located, other, columns = solve_with_columns(*primals)
        tangent_space, curvature_of = (
            functools.partial(f, problem) for f in (_tangent_space, _curvature)
        )
        curvature = on_branch(curvature_of, tangent_space, problem.options.block)(
            primals[0], located
        )
        tangent = push((columns, curvature), tangents[0])
        return (located, other, columns), (tangent[0], without_derivative(other), tangent[1])

    return solve(parameters, *start)


def attach_monodromy(problem: Problem, matrix: Array, parameters: Array, located: Located) -> Array:
    """`matrix`, whose derivative is that of the monodromy matrix along the branch."""
    tangent_space, slopes_of = (
        functools.partial(f, problem) for f in (_tangent_space, _monodromy_slopes)
    )

    @jax.custom_jvp
    def attach(matrix: Array, parameters: Array, located: Located) -> Array:
        return matrix

    def rule(primals: tuple, tangents: tuple) -> tuple:
        slopes = on_branch(slopes_of, tangent_space, problem.options.block)(*primals[1:])
        return attach(*primals), push(slopes, tangents[1])

    attach.defjvp(rule)
    return attach(matrix, parameters, located)
