"""Gaits of any walker: steps that repeat, found by Newton's method on the section."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from vrw_jax.base import batch_sizes
from vrw_jax.base.checks import check_int, check_reals, has_traced_leaf
from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import Outcome
from vrw_jax.base.printing import (
    format_each_batch_element,
    format_heading_and_rows,
    format_numbers,
    format_outcome_counts,
    format_quantity,
)
from vrw_jax.base.types import Scalar
from vrw_jax.base.walker import (
    AbstractWalker,
    check_arguments,
    check_parameters,
    compile_step,
    make_return_map,
)
from vrw_jax.gaits.fixed_points import FixedPointResult, solve_fixed_point_implicit
from vrw_jax.lanes.batching import map_in_batches
from vrw_jax.lanes.saved_traces import call_compiled_program


class HybridGait(NamedTuple):
    """Gait of a `HybridSystem` or another walker of yours, which repeats after `period_n` steps.

    - `section_state`: section coordinates at which the gait begins, shape (n,);
    - `period`: duration of all its steps, s;
    - `last_step`: the last step of the gait, for a `HybridSystem` a `HybridStep`;
    - `fixed_point`: the fixed point, with the Jacobian and the status of Newton's method;
    - `outcome`: STEPPED if a gait was found, or the `Outcome` that states why not. All numbers of
      the gait are then zero;
    - `values`: the walker's measures by name, as means over the steps of the gait.

    Examples:
        >>> decay = lambda y, p: jnp.stack([-p["rate"] * y[0], 1.0 + 0.0 * y[1]])
        >>> kick = lambda y, p: jnp.stack([y[0] + 1.0, 0.0 * y[1]])
        >>> guards = {"kick": vrw.hybrid.Guard(lambda y, p: 1.0 - y[1], kick)}
        >>> system = vrw.HybridSystem(
        ...     modes={"decay": vrw.hybrid.Mode(decay, guards)},
        ...     section="kick",
        ...     state=("level", "time"),
        ...     project=lambda y, p: y[:1],
        ...     embed=lambda x, p: jnp.stack([x[0], 0.0 * x[0]]),
        ... )
        >>> gait = vrw.limit_cycle({"rate": 1.0}, model=system, guess=[1.0])
        >>> print(f"{gait.section_state[0]:.6f} {gait.multipliers[0].real:.6f}")
        1.581977 0.367879
    """

    section_state: Float[Array, " n"]
    period: Scalar
    last_step: Any
    fixed_point: FixedPointResult
    outcome: Int[Array, ""]
    values: dict[str, Scalar]

    @property
    def converged(self) -> Bool[Array, "..."]:
        """Return whether the gait was found."""
        return jnp.asarray(self.outcome == Outcome.STEPPED)

    @property
    def found(self) -> Bool[Array, "..."]:
        """Return whether the gait was found, as of other gaits."""
        return self.converged

    @property
    def warm_start(self) -> Array:
        """Return guesses from which the search for a similar gait begins, shape (1, n)."""
        return self.section_state[..., None, :]

    @property
    def multipliers(self) -> Complex[Array, "... n"]:
        """Return the Floquet multipliers in the order of decreasing modulus, shape (n,)."""
        return self.fixed_point.multipliers

    @property
    def spectral_radius(self) -> Any:
        """Return the largest modulus of a multiplier, which is below 1 for stable gaits."""
        return jnp.abs(self.multipliers[..., 0])

    @property
    def why(self) -> Any:
        """Return a sentence on how the search ended; for a batch, an array of sentences."""
        describe = lambda code, newton: (
            newton
            if code in (Outcome.STEPPED, Outcome.NO_CYCLE_FOUND)
            else f"A step of the search failed: {Outcome(int(code)).name}."
        )
        return format_each_batch_element(describe, self.outcome, self.fixed_point.ending)

    def __repr__(self) -> str:
        if isinstance(self.period, jax.core.Tracer):
            return f"HybridGait{tuple(self)}"
        rows = [
            ("section state", format_numbers(self.section_state)),
            ("period", format_quantity(self.period, "s")),
            ("multipliers", format_numbers(np.asarray(self.multipliers))),
            *((name, format_quantity(value, "")) for name, value in self.values.items()),
            ("search", self.why),
        ]
        if np.ndim(self.period):
            rows = [("gaits", format_outcome_counts(self.outcome, Outcome))]
        return format_heading_and_rows("HybridGait", rows)


def find_hybrid_gait(
    walker: Any, params: Any, guess: Any, period_n: int, options: Any
) -> HybridGait:
    """Return the gait near `guess`, or near a start of the walker, differentiable by parameters."""
    params, guesses, options = _check_search(walker, params, guess, period_n, options, 1)
    return call_compiled_program(
        find_gait_from_guesses, (walker, period_n), params, guesses, options
    )


def find_hybrid_gaits(
    walker: Any, params: Any, guess: Any, period_n: int, options: Any
) -> HybridGait:
    """Return the gaits of a batch, in which an element without a gait has a code."""
    params, guesses, options = _check_search(walker, params, guess, period_n, options, 2)
    lengths = {len(leaf) for leaf in jax.tree.leaves(params) if leaf.ndim}
    lengths |= {len(guesses)} if guesses.ndim == 3 else set()
    if len(lengths) != 1:
        raise ValueError(
            f"the batch has the lengths {sorted(lengths)}, but parameters that are arrays and "
            "guesses have one common length: give arrays of one length."
        )
    (n,) = lengths
    arrays: Any = jnp if has_traced_leaf(params, guesses) else np
    params = jax.tree.map(lambda leaf: arrays.broadcast_to(leaf, (n,)), params)
    guesses = arrays.broadcast_to(guesses, (n, *guesses.shape[-2:]))
    find_gaits = lambda params, guesses: call_compiled_program(
        _find_gaits, (walker, period_n), params, guesses, options
    )
    if arrays is jnp:
        return find_gaits(params, guesses)
    return map_in_batches(find_gaits, batch_sizes.GAIT_BATCH_SIZES, params, guesses)


def _check_search(
    walker: Any, params: Any, guess: Any, period_n: int, options: Any, max_axes: int
) -> tuple[Any, Array, StepOptions]:
    """Return parameters, guesses of shape ([batch,] starts, n) and options, or raise an error."""
    check_int("period_n", period_n)
    params = check_parameters(params)
    for leaf in jax.tree.leaves(params):
        if leaf.ndim >= max_axes:
            raise ValueError(
                f"a parameter has shape {leaf.shape}, but "
                + (
                    "this search is for one walker: use vrw.limit_cycles for a batch."
                    if max_axes == 1
                    else "a batch has one axis: give numbers or lists of numbers."
                )
            )
    if guess is None and walker.starts is None:
        raise ValueError(
            "guess is None, but the search for a gait of this walker starts there: give section "
            "coordinates near the gait, or starts= in the definition of the walker."
        )
    if guess is None:
        has_batch = any(leaf.ndim for leaf in jax.tree.leaves(params))
        axes = jax.tree.map(lambda leaf: 0 if leaf.ndim else None, params)
        propose = jax.vmap(walker.starts, (axes,)) if has_batch else walker.starts
        guesses = check_reals("starts", propose(params))
        if guesses.ndim - has_batch == 1:
            guesses = guesses[..., None, :]
    else:
        guesses = check_reals("guess", guess)[..., None, :]
    one_guess = guesses[(0,) * (guesses.ndim - 1)]
    one_params = jax.tree.map(lambda leaf: leaf if leaf.ndim == 0 else leaf[0], params)
    _, _, options = check_arguments(walker, one_params, one_guess, options, 1)
    if not 2 <= guesses.ndim <= max_axes + 1:
        raise ValueError(
            f"guess has shape {jnp.shape(guess)}, but it holds section coordinates: give one "
            f"number for each{', or one row for each element of the batch' * (max_axes == 2)}."
        )
    return params, guesses, options


def _find_gaits(
    walker_and_period: tuple[AbstractWalker, int], params: Any, guesses: Array, options: StepOptions
) -> HybridGait:
    find = functools.partial(find_gait_from_guesses, walker_and_period)
    return jax.vmap(find, in_axes=(0, 0, None))(params, guesses, options)


def find_gait_from_guesses(
    walker_and_period: tuple[AbstractWalker, int], params: Any, guesses: Array, options: StepOptions
) -> HybridGait:
    """Return the gait from the first guess that leads to one, or the failure of the first guess."""
    search = functools.partial(_search_from_guess, *walker_and_period, params, options)
    if len(guesses) == 1:
        return search(guesses[0])
    gaits = jax.vmap(search)(guesses)
    return jax.tree.map(lambda x: x[jnp.argmax(gaits.converged)], gaits)


def _search_from_guess(
    walker: AbstractWalker, period_n: int, params: Any, options: StepOptions, guess: Array
) -> HybridGait:
    fixed_point = solve_fixed_point_implicit(
        make_return_map(walker, params, options),
        guess,
        period_n=period_n,
        invariants=[lambda x: walker.evaluate_invariants(params, x)] if walker.invariants else (),
    )
    x, period = fixed_point.x, jnp.zeros((), fixed_point.x.dtype)
    values = []
    numbers = jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves((params, guess))])
    outcome = jnp.where(jnp.all(jnp.isfinite(numbers)), Outcome.STEPPED, Outcome.BAD_INPUT)
    for _ in range(period_n):
        step = compile_step(walker)(params, x, options)
        values.append(walker.measure_step(params, x, step, options))
        outcome = jnp.where(outcome == Outcome.STEPPED, step.outcome, outcome)
        x, period = step.section_state, period + step.duration
    outcome = jnp.where(
        (outcome == Outcome.STEPPED) & ~fixed_point.converged, Outcome.NO_CYCLE_FOUND, outcome
    )
    keep = lambda value: jnp.where(outcome == Outcome.STEPPED, value, jnp.zeros_like(value))
    make_finite = lambda value: jnp.where(jnp.isfinite(value), value, 0.0)
    return HybridGait(
        keep(fixed_point.x),
        keep(period),
        jax.tree.map(keep, step),
        fixed_point._replace(
            x=keep(fixed_point.x),
            jacobian=make_finite(fixed_point.jacobian),
            residual=make_finite(fixed_point.residual),
        ),
        outcome.astype(jnp.int32),
        {name: keep(sum(value[name] for value in values) / period_n) for name in values[0]},
    )
