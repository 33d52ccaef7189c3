"""Find fixed points of return maps by Newton's method on the section, for any system."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Complex, Float, Int

from vrw_jax.base.checks import (
    check_callable,
    check_int,
    check_positive,
    check_reals,
    check_type,
)
from vrw_jax.base.elementwise import Scalar
from vrw_jax.base.progress import announce_wait
from vrw_jax.base.results import (
    format_each_batch_element,
    format_heading_and_rows,
    format_numbers,
    format_quantity,
)
from vrw_jax.base.small_matrices import (
    UNIT_CIRCLE_DISTANCE,
    compute_multipliers,
    floquet_multipliers,
)
from vrw_jax.flow.hybrid_simulation import Termination
from vrw_jax.flow.orbits import ReturnMap
from vrw_jax.lanes.autodiff import evaluate_with_jacobian, make_zero_tangent
from vrw_jax.lanes.environment import with_default_jax_settings
from vrw_jax.lanes.program import get_compiled_program

UNIT_MULTIPLIER_ADVICE = (
    "A multiplier is 1, which a conserved quantity or a fold causes: name the conserved quantity "
    "in invariants=, take it out of the state, or move the parameter away from the fold."
)
"""Advice for a state at which the equations of the fixed point are singular."""


def count_unit_multipliers(jacobian: Float[np.ndarray, "... n n"]) -> Int[np.ndarray, "..."]:
    """Return how many multipliers are 1, up to the round-off of two equal multipliers."""
    is_unit_multiplier = np.abs(compute_multipliers(jacobian) - 1.0) < UNIT_CIRCLE_DISTANCE
    return np.asarray(is_unit_multiplier.sum(-1))


class FixedPointResult(NamedTuple):
    """Fixed point of a map, and the Jacobian of the map at that point.

    - `x`: fixed point, shape (n,);
    - `jacobian`: Jacobian of the `period_n`-th iterate of the map, shape (n, n);
    - `residual`: largest absolute component of map(x) - x;
    - `converged`: whether Newton's method converged;
    - `n_iterations`: number of Newton iterations;
    - `termination`: `Termination` status of the simulation of a `ReturnMap` from `x`; None for any
      other map;
    - `n_invariants`: number of conserved quantities that the search kept, each of which has a
      multiplier of 1; None if it keeps none.

    Examples:
        >>> result = vrw.solve_fixed_point(lambda x: 0.5 * x + 1.0, jnp.zeros(1))
        >>> float(result.x[0]), float(result.jacobian[0, 0])
        (2.0, 0.5)
        >>> result.multipliers.tolist()
        [(0.5+0j)]
    """

    x: Float[Array, " n"]
    jacobian: Float[Array, "n n"]
    residual: Scalar
    converged: Bool[Array, ""]
    n_iterations: Int[Array, ""]
    termination: Int[Array, ""] | None = None
    n_invariants: Int[Array, ""] | None = None

    @property
    def multipliers(self) -> Complex[Array, "... n"]:
        """Return the Floquet multipliers in the order of decreasing modulus, shape (..., n).

        The multipliers are NaN where the Jacobian is not finite.
        """
        is_finite = jnp.isfinite(self.jacobian).all((-2, -1))[..., None]
        finite_jacobian = jnp.where(is_finite[..., None], self.jacobian, 0.0)
        return jnp.where(is_finite, floquet_multipliers(finite_jacobian), jnp.nan)

    @property
    def ending(self) -> Any:
        """Return a sentence that describes whether Newton's method converged.

        A second sentence gives the reason if a multiplier is 1. For a batch the result is an array
        of such texts.
        """

        def describe_convergence(
            converged: bool, n_iterations: int, is_singular: bool, n_invariants: int
        ) -> str:
            converged_text = "converged" if converged else "did not converge"
            convergence = f"Newton's method {converged_text} after {n_iterations} iterations"
            if is_singular:
                return f"{convergence}. {UNIT_MULTIPLIER_ADVICE}"
            if converged:
                return convergence + "."
            check = ", and check that the map conserves the invariants" if n_invariants else ""
            return f"{convergence}: start nearer to the fixed point{check}."

        n_invariants = np.asarray(0 if self.n_invariants is None else self.n_invariants)
        return format_each_batch_element(
            describe_convergence,
            self.converged,
            self.n_iterations,
            np.asarray(count_unit_multipliers(np.asarray(self.jacobian)) > n_invariants),
            np.broadcast_to(n_invariants, np.shape(self.converged)),
        )

    def __repr__(self) -> str:
        if isinstance(self.x, jax.core.Tracer) or np.ndim(self.x) != 1:
            return f"FixedPointResult{tuple(self)}"
        text_rows = [
            ("converged", f"{bool(self.converged)}, after {int(self.n_iterations)} iterations"),
            ("x", format_numbers(self.x)),
            ("residual", format_quantity(self.residual, "")),
            ("multipliers", format_numbers(compute_multipliers(np.asarray(self.jacobian)))),
        ]
        if self.termination is not None:
            text_rows.append(("simulation", Termination(int(self.termination)).meaning))
        return format_heading_and_rows("FixedPointResult", text_rows)


MAX_NEWTON_ITERATIONS = 30
"""Default limit of Newton iterations. The value is chosen far above the number that a start near
the fixed point needs.
"""


MAX_RESIDUAL = 1e-6
"""Largest change of a fixed point, relative to the sizes of the start and its image, for a map
whose Jacobian is small.

If the map does not conserve the invariants, the equations have no solution, although the
corrections vanish. From a start with a singular Jacobian, Newton's method may also move so far that
any change is round-off. The value is chosen far above the error of a step with default options.
"""

MAX_RESIDUAL_SIZE_RATIO = 1e3
"""Largest ratio of the sizes of a fixed point and of its start up to which the residual is relative
to the fixed point. Beyond it, residuals that are round-off of a distant state would be accepted.
"""

RESIDUAL_ROUNDOFF_IN_EPS = 1e3
"""Smallest limit of a residual, in units of the machine epsilon. The value is chosen because terms
of a map may be a thousand times its values.
"""


@announce_wait("the map and its derivatives", "10 s")
def solve_fixed_point(
    function: Callable[[Array], Array],
    start: Float[Array, " n"],
    *,
    period_n: int = 1,
    tolerance: float | Scalar = 1e-12,
    units: Any = None,
    max_iterations: int = MAX_NEWTON_ITERATIONS,
    invariants: Sequence[Callable[[Array], Array]] = (),
    max_residual: float | Scalar = MAX_RESIDUAL,
    differentiates_jacobian: bool = True,
) -> FixedPointResult:
    """Find a fixed point of `function` applied `period_n` times, by Newton's method.

    The result is differentiable with respect to all values that `function` closes over, by the
    implicit function theorem. Derivatives of order n of the fixed point require those of `function`
    to the same order, and derivatives of its Jacobian to the next order. If Newton's method does
    not converge, the start is returned unchanged, without derivatives.

    Args:
        function: map from a vector to a vector of the same shape, differentiable in forward mode.
            For a hybrid system the map is a `ReturnMap`, which has no fixed point if its simulation
            ends early.
        start: initial guess of Newton's method, shape (n,).
        period_n: number of times that the map is applied.
        tolerance: largest component of Newton's last correction, in `units`.
        units: units of the components of `start`, a number or shape (n,). By default, the unit of a
            component is its size at the start or at the fixed point, whichever is larger.
        max_iterations: largest number of Newton iterations.
        invariants: functions of the state that the map conserves, such as an energy. Fixed points
            then form a curve, and that with the invariants of `start` is found. If a map does not
            conserve them, the search does not converge. Derivatives are those along this curve: by
            a value that breaks the conservation there are none, and what is returned is no
            derivative.
        max_residual: largest change of a fixed point by the map, relative to the largest of the
            `units` and of the components of the start, its image and, up to a thousand times
            these, the fixed point. The limit is at least ten times `tolerance`, and is multiplied
            by 1 plus the norm of the Jacobian.
        differentiates_jacobian: whether the Jacobian has derivatives; if not, they are NaN. Choose
            False if second derivatives of the map are expensive.

    Returns:
        A `FixedPointResult`: the state, its multipliers, and the status of the iteration.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> result = vrw.solve_fixed_point(lambda x: jnp.cos(x), jnp.array([0.7]))
        >>> print(f"{result.x[0]:.6f} {bool(result.converged)}")
        0.739085 True
    """
    check_callable("function", function, "that maps a state to the next")
    start, period_n = check_reals("start", start), check_int("period_n", period_n)
    max_iterations = check_int("max_iterations", max_iterations)
    start = lax.stop_gradient(start)
    check_vector_map(function, "start", start)
    for name, value in ("tolerance", tolerance), ("max_residual", max_residual):
        (check_reals if isinstance(value, jax.Array) else check_positive)(name, value)
    check_type("invariants", invariants, (list, tuple), "give a list of functions of the state")
    for invariant in invariants:
        check_callable("an invariant", invariant, "of the state")

    tolerance, max_residual = lax.stop_gradient(
        [jnp.asarray(x, start.dtype) for x in (tolerance, max_residual)]
    )
    # A unit of 0 is replaced by the size of the component.
    units = jnp.zeros_like(start) if units is None else check_state_units(units, start)
    newton_configuration = (
        function, period_n, tuple(invariants), max_iterations, differentiates_jacobian,
    )  # fmt: skip
    find_fixed_point: Any = functools.partial(_find_fixed_point_of_iterate, newton_configuration)
    arguments = start, tolerance, max_residual, units
    if not isinstance(function, ReturnMap):
        return find_fixed_point(*arguments)
    compiled_program = get_compiled_program(
        _find_fixed_point_of_iterate, newton_configuration, *arguments
    )
    fixed_point = (compiled_program or find_fixed_point)(*arguments)
    return fixed_point._replace(termination=function.find_termination(fixed_point.x, period_n))


def check_vector_map(function: Callable, state_name: str, state: Array) -> None:
    """Raise an error unless the map maps the state, a vector, to a vector of the same shape."""
    if state.ndim != 1 or not state.size:
        raise ValueError(
            f"{state_name} has shape {state.shape}, but it is a vector: give an array of shape "
            "(n,)."
        )
    map_output = jax.eval_shape(function, state)
    if getattr(map_output, "shape", None) != state.shape:
        map_output_description = getattr(map_output, "shape", type(map_output).__name__)
        raise ValueError(
            f"the map gives {map_output_description} for a {state_name} of shape {state.shape}, "
            "but it must give an array of that shape: take a map of a state to the next state."
        )


def check_state_units(units: Any, state: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return one positive unit for each component of a state, or raise an error."""
    units = check_reals("units", units)
    if units.shape not in ((), state.shape) or (
        not isinstance(units, jax.core.Tracer) and not np.all((units > 0.0) & np.isfinite(units))
    ):
        raise ValueError(
            f"units are {units}, but each component of the state has one positive unit: give a "
            f"number above 0, or an array of shape {state.shape}."
        )
    return jnp.broadcast_to(lax.stop_gradient(units).astype(state.dtype), state.shape)


def _find_fixed_point_of_iterate(
    newton_configuration: tuple,
    start: Array,
    tolerance: Array,
    max_residual: Array,
    units: Array,
) -> FixedPointResult:
    function, period_n, invariants, *loop_configuration = newton_configuration

    def evaluate_equations(x: Array) -> Array:
        """Return the state after `period_n` maps, and the changes of the invariants at `x`."""
        next_x = functools.reduce(lambda y, _: function(y), range(period_n), x)
        changes = [jnp.ravel(invariant(x) - invariant(start)) for invariant in invariants]
        return jnp.concatenate([next_x, *changes])

    closure_converted_map, closed_over_values = jax.closure_convert(evaluate_equations, start)
    result = _run_newton_loop(
        closure_converted_map,
        *loop_configuration,
        start,
        tolerance,
        max_residual,
        units,
        *closed_over_values,
    )
    n_invariants = sum(jax.eval_shape(invariant, start).size for invariant in invariants)
    return result._replace(n_invariants=jnp.asarray(n_invariants, jnp.int32))


ClosureConvertedMap = Callable[..., Array]


def _solve_fixed_point_equations(jacobian: Array, right_side: Array) -> Array:
    """Return dx with dx - J dx = `right_side`, where rows of invariants have no dx.

    With invariants there are more equations than unknowns, but they agree near a solution.
    """
    n_equations, n_unknowns = jacobian.shape
    matrix = jnp.eye(n_equations, n_unknowns, dtype=jacobian.dtype) - jacobian
    if n_equations == n_unknowns:
        return jnp.linalg.solve(matrix, right_side)
    q, r = jnp.linalg.qr(matrix)
    return jax.scipy.linalg.solve_triangular(r, q.T @ right_side)


N_FINAL_ITERATIONS = 2
"""Number of Newton iterations after convergence. The value is chosen because the map may jump near
the point, and because the last Jacobian is then that of the fixed point.
"""


MAX_STALLED_ITERATIONS = 3
"""Number of iterations in which the correction does not halve, after which it is compared with the
largest component. The value is chosen because far from a solution few corrections grow in turn.
"""


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1, 2))
def _run_newton_loop(
    closure_converted_map: ClosureConvertedMap,
    max_iterations: int,
    differentiates_jacobian: bool,
    start: Array,
    tolerance: Array,
    max_residual: Array,
    units: Array,
    *closed_over_values: Any,
) -> FixedPointResult:
    """Find the fixed point in a single loop, so that the map is compiled only once."""

    def is_newton_searching(correction_norm: Array, n_iterations: Array) -> Array:
        return (
            (correction_norm > tolerance)
            & (n_iterations < max_iterations)
            & jnp.isfinite(correction_norm)
        )

    def needs_newton_iteration(loop_state: tuple) -> Array:
        _, norm, n_iterations, n_final_iterations, *_ = loop_state
        is_final_needed = (norm <= tolerance) & (n_final_iterations < N_FINAL_ITERATIONS)
        return is_newton_searching(norm, n_iterations) | is_final_needed

    def iterate_newton(loop_state: tuple) -> tuple:
        x, last_norm, n_iterations, n_final_iterations, n_stalled, size, *_ = loop_state
        is_searching = is_newton_searching(last_norm, n_iterations).astype(n_iterations.dtype)
        values, jacobian = evaluate_with_jacobian(
            lambda y: closure_converted_map(y, *closed_over_values), x
        )
        defect = values - jnp.pad(x, (0, len(values) - len(x)))
        newton_correction = _solve_fixed_point_equations(jacobian, defect)
        jacobian, residual = jacobian[: len(x)], jnp.max(jnp.abs(defect[: len(x)]))
        start_size = jnp.max(jnp.maximum(size, jnp.abs(values[: len(x)])))
        size = jnp.where(n_iterations == 0, start_size, size)
        # The sum of the terms of a component is no more accurate than its largest term.
        component_sizes = jnp.max(
            jnp.abs(jnp.stack([start, x, x + newton_correction, jnp.abs(jacobian) @ jnp.abs(x)])), 0
        )
        component_units = jnp.where(units > 0.0, units, component_sizes)
        component_units = jnp.where(component_units > 0.0, component_units, 1.0)
        # The correction is also checked in the last iterations, because the map may jump near the
        # point.
        correction_norm = jnp.max(jnp.abs(newton_correction) / component_units)
        n_stalled = jnp.where(correction_norm >= 0.5 * last_norm, n_stalled + 1, 0)
        # The round-off of the other components may be all that is left of a component.
        correction_norm = jnp.where(
            n_stalled < MAX_STALLED_ITERATIONS,
            correction_norm,
            jnp.max(jnp.abs(newton_correction)) / jnp.max(component_units),
        )
        next_x = jnp.where(jnp.all(jnp.isfinite(newton_correction)), x + newton_correction, x)
        return (
            next_x,
            correction_norm,
            n_iterations + is_searching,
            n_final_iterations + 1 - is_searching,
            n_stalled,
            size,
            jacobian,
            residual,
        )

    zero, initial_norm = jnp.zeros((), jnp.int32), jnp.ones((), start.dtype)
    initial_loop_state = (
        start,
        initial_norm,
        *[zero] * 3,
        jnp.max(jnp.maximum(units, jnp.abs(start))),
        jnp.zeros((start.size,) * 2, start.dtype),
        initial_norm,
    )
    x, correction_norm, n_iterations, *_, size, jacobian, residual = lax.while_loop(
        needs_newton_iteration, iterate_newton, initial_loop_state
    )
    size = jnp.maximum(size, jnp.minimum(jnp.max(jnp.abs(x)), MAX_RESIDUAL_SIZE_RATIO * size))
    # The residual is the last correction times a matrix of the size of the Jacobian.
    growth = 1.0 + jnp.max(jnp.sum(jnp.abs(jacobian), 1))
    roundoff = RESIDUAL_ROUNDOFF_IN_EPS * jnp.finfo(x.dtype).eps
    largest = jnp.maximum(jnp.maximum(max_residual, 10.0 * tolerance), roundoff)
    has_newton_converged = correction_norm <= tolerance
    has_newton_converged &= residual <= largest * growth * size
    return FixedPointResult(
        jnp.where(has_newton_converged, x, start),
        jacobian,
        residual,
        has_newton_converged,
        n_iterations,
    )


@_run_newton_loop.defjvp
@with_default_jax_settings
def _run_newton_jvp(
    closure_converted_map: ClosureConvertedMap,
    max_iterations: int,
    differentiates_jacobian: bool,
    primals: tuple,
    tangents: tuple,
) -> tuple[FixedPointResult, FixedPointResult]:
    """Return the fixed point and its tangent by the implicit function theorem.

    The tangent depends on the fixed point. Derivatives of the tangent therefore use the same rule.
    """
    result = _run_newton_loop(
        closure_converted_map, max_iterations, differentiates_jacobian, *primals
    )
    closed_over_values, value_tangents = tuple(primals[4:]), tuple(tangents[4:])
    compute_jacobian = lambda x, *values: evaluate_with_jacobian(
        lambda x: closure_converted_map(x, *values), x
    )[1]
    _, image_tangent = jax.jvp(
        functools.partial(closure_converted_map, result.x), closed_over_values, value_tangents
    )
    jacobian = compute_jacobian(result.x, *closed_over_values)
    x_tangent = jnp.where(
        result.converged, _solve_fixed_point_equations(jacobian, image_tangent), 0.0
    )
    jacobian_tangent = jnp.full_like(result.jacobian, jnp.nan) * jnp.sum(x_tangent)
    if differentiates_jacobian:
        _, jacobian_tangent = jax.jvp(
            compute_jacobian, (result.x, *closed_over_values), (x_tangent, *value_tangents)
        )
    return result, make_zero_tangent(result)._replace(
        x=x_tangent, jacobian=jacobian_tangent[: len(result.x)]
    )


@functools.partial(jax.jit, static_argnums=0)
def _linearize_map(function: Callable, args: Any, x: Array, p: Array) -> tuple[Array, tuple]:
    """Linearize the map at many points."""
    linearize = lambda x, p: evaluate_with_jacobian(lambda x, p: function(args, x, p), x, p)
    return jax.vmap(linearize)(x, p)


RELATIVE_PROBE_LENGTH = 1e-3
"""Distance, relative to the state, over which the change of the map's Jacobian is measured. The
value is chosen between the round-off of the Jacobian and a change that is not linear.
"""

NOISE_PROBES = 1e-12 * np.arange(32.0)
"""Relative changes of state and parameter at which the round-off of a map is measured. The values
are chosen because the quadratic terms of the map are then far below its round-off.
"""

MAX_NEWTON_REMAINDER = 1e-10
"""Largest size of a component that may be the remainder of a Newton iteration towards 0. The value
is chosen because the searches for gaits end at corrections of that size. Its residual
must also exceed `MIN_REMAINDER_RESIDUAL` times its size.
"""

MIN_REMAINDER_RESIDUAL = 1e-6
"""Smallest residual of a remainder as a fraction of its size. The value is chosen because Newton's
method leaves far smaller residuals at a fixed point, unless a multiplier is almost 1.
"""

MIN_UNIT_PER_NOISE = 1e11
"""Smallest unit of a component as a multiple of the round-off of its image. The value is chosen
because ten times the round-off is then the default tolerance of 1e-10.
"""


def estimate_state_units(
    function: Callable, args: Any, x: np.ndarray, p: float, parameter_bounds: tuple[float, float]
) -> np.ndarray:
    """Estimate the size of each component of the fixed points of x -> `function(args, x, p)`.

    The size is that of `x`, or that of the change of the fixed point between the bounds of the
    parameter if the change is larger. The change solves the quadratic equation of the branch in the
    direction of its tangent, so that the change is finite at a fold. The size scales with the units
    of state and parameter. It exceeds the round-off of the map, and is 1 for a component that is
    zero and remains zero. The remainder of a Newton iteration towards zero counts as zero.
    """

    def linearize(x: np.ndarray, p: Any) -> tuple[np.ndarray, ...]:
        # Each call has the same shape, so that one program is compiled.
        x, p = np.resize(x, (len(NOISE_PROBES), x.shape[-1])), np.resize(p, len(NOISE_PROBES))
        image, (jacobian, rate) = _linearize_map(function, args, jnp.asarray(x), jnp.asarray(p))
        return np.asarray(image), np.asarray(jacobian), np.asarray(rate)

    with np.errstate(all="ignore"):
        parameter_range = parameter_bounds[1] - parameter_bounds[0]
        image, jacobian, rate = (values[0] for values in linearize(x, p))
        residual_limits = np.where(
            abs(x) < MAX_NEWTON_REMAINDER, MIN_REMAINDER_RESIDUAL * abs(x), np.inf
        )
        if (is_remainder := abs(image - x) > residual_limits).any():
            x = np.where(is_remainder, 0.0, x)
            image, jacobian, rate = (values[0] for values in linearize(x, p))
        forcing = parameter_range * rate
        is_size_unknown = (x == 0.0) & (forcing == 0.0)
        if is_size_unknown.any():
            # At a crossing the change between the bounds is of second order.
            changes = np.max(abs(linearize(x, np.array(parameter_bounds))[0] - image), 0)
            forcing = np.where(is_size_unknown, changes, forcing)
        sizes = np.where(x == 0.0, np.fmax(abs(image), abs(forcing)), abs(x))
        x_probes, p_probes = x + np.outer(NOISE_PROBES, sizes), p + NOISE_PROBES * parameter_range
        linear_changes = (x_probes - x) @ jacobian.T + np.outer(p_probes - p, rate)
        noise = np.max(abs(linearize(x_probes, p_probes)[0] - image - linear_changes), 0)
        sizes = np.fmax(sizes, MIN_UNIT_PER_NOISE * noise)
        units = np.where((sizes > 0.0) & np.isfinite(sizes), sizes, 1.0)
        in_units = lambda matrix: np.nan_to_num(matrix * units / units[:, None])
        left, singular_values, right = np.linalg.svd(np.eye(len(x)) - in_units(jacobian))
        # At a fold, round-off replaces the singular value 0, and the tangent is large.
        singular_values = np.maximum(singular_values, np.finfo(x.dtype).eps)
        solve = lambda vector: right.T @ (left.T @ vector / singular_values)
        tangent = solve(np.nan_to_num(forcing / units))
        tangent_size = np.max(abs(tangent))
        if tangent_size == 0.0:
            return units
        probe = RELATIVE_PROBE_LENGTH / tangent_size * tangent
        jacobian_change = in_units(linearize(x + units * probe, p)[1][0] - jacobian)
        curvature = solve(jacobian_change @ tangent) / RELATIVE_PROBE_LENGTH
        change = 2.0 * tangent / (1.0 + np.sqrt(1.0 + 2.0 * np.max(abs(curvature))))
        return units * np.fmax(1.0, abs(change))
