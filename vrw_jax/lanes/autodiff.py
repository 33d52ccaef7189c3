"""Derivatives of any order and mode for a function that supports only forward-mode AD.

Loops of unknown length, such as adaptive solver steps until an event, have no reverse mode. The
rule in this module computes the Jacobian in forward mode, with respect to the inputs that have
tangents. It returns the product of the Jacobian and the tangent. The product is linear in the
tangent, so `jax.grad` transposes a small matrix instead of a loop. The Jacobian itself has the same
rule, so Hessians work in every combination of modes.

Directions of forward mode come from `jax.vmap` around a derivative. `with_batched_jvp` and its
parts put them on the first axis of arrays, so that loops are traced once and not again for the
vmap.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, PyTree

from vrw_jax.lanes.batching import BatchFunction, unbatch
from vrw_jax.lanes.environment import with_default_jax_settings
from vrw_jax.lanes.machine_code import targets_machine_code

ForwardFunction = Callable[..., tuple[PyTree[Array], PyTree[Array]]]
"""Function of floating-point arrays that returns (float outputs, other outputs without
derivatives).
"""


def enable_all_ad_modes(
    function: ForwardFunction,
    function_to_differentiate: ForwardFunction | None = None,
    compile_jacobian: Callable[[ForwardFunction, tuple], ForwardFunction] = lambda f, _: f,
    differentiated_arguments: tuple[tuple[int, ...], ...] = (),
    n_directions_at_once: int | None = None,
) -> ForwardFunction:
    """Return `function` with derivatives in forward and reverse mode, to any order.

    All arguments of `function` must be floating-point arrays. `jax.jvp` must be able to
    differentiate it to the requested order, and its closure must not contain values that are
    differentiated. If `function_to_differentiate` is given, derivatives are those of this function,
    which may for example use tighter tolerances. `compile_jacobian` compiles Jacobians of any
    order, or replaces them by other functions; its second argument are the `argnums` of each order.
    A Jacobian returns (columns, float outputs), and the other outputs, as those of
    `compute_jacobian_columns`. Function and Jacobians are compiled once each: outside of `jit`,
    forward mode, reverse mode and single directions all call the same compiled Jacobian.

    - `differentiated_arguments`: `argnums` of the orders that `function` already has;
    - `n_directions_at_once`: see `compute_jacobian_columns`.
    """
    compiled_function = jax.jit(function)
    wrapped_function = jax.custom_jvp(compiled_function)

    @functools.cache
    def get_differentiable_jacobian(argnums: tuple[int, ...]) -> ForwardFunction:
        def compute_jacobian(*arrays: Any) -> tuple[PyTree, PyTree]:
            columns, float_outputs, nonfloat_outputs = compute_jacobian_columns(
                function_to_differentiate or function,
                arrays,
                argnums,
                has_lanes=False,
                n_directions_at_once=n_directions_at_once,
            )
            return (columns, float_outputs), nonfloat_outputs

        argnums_by_order = (*differentiated_arguments, argnums)
        return enable_all_ad_modes(
            compile_jacobian(compute_jacobian, argnums_by_order),
            compute_jacobian,
            compile_jacobian,
            argnums_by_order,
            n_directions_at_once,
        )

    @with_default_jax_settings
    def compute_function_jvp(primals: tuple, tangents: tuple) -> tuple:
        perturbed_argnums = tuple(
            i for i, tangent in enumerate(tangents) if not isinstance(tangent, SymbolicZero)
        )
        if not perturbed_argnums:
            function_result = wrapped_function(*primals)
            return function_result, make_zero_tangent(function_result)
        (columns, float_outputs), nonfloat_outputs = get_differentiable_jacobian(perturbed_argnums)(
            *primals
        )
        output_tangent = _apply_columns(columns, [tangents[i] for i in perturbed_argnums])
        return (float_outputs, nonfloat_outputs), (
            output_tangent,
            make_zero_tangent(nonfloat_outputs),
        )

    wrapped_function.defjvp(compute_function_jvp, symbolic_zeros=True)

    def call_differentiable_function(*arrays: Any) -> tuple:
        # The rule costs as much as a solver step, so it is applied only to traced arguments.
        if not any(isinstance(x, jax.core.Tracer) for x in arrays):
            return compiled_function(*arrays)
        # Inside `jit`, JAX 0.10 rejects a NumPy array that `vmap` maps as an argument of the rule.
        return wrapped_function(
            *(
                jnp.array(array) if isinstance(getattr(array, "val", None), np.ndarray) else array
                for array in arrays
            )
        )

    return call_differentiable_function


def differentiate(
    function: Callable,
    reference: Callable,
    make_column_function: Callable[[Any, tuple[int, ...]], Callable] | None = None,
) -> Callable:
    """Return a function of trees of arrays with derivatives in every mode, to any order.

    Without a derivative, the result only calls the compiled `function`.

    - `reference`: function with the same result, from which derivatives are computed;
    - `make_column_function`: function of the structure of the arguments and of `argnums`, numbers
      of leaves. It returns a function of all leaves, whose results are those of
      `compute_jacobian_columns`. It replaces `reference` for first derivatives.
    """

    @functools.cache
    def differentiate_leaf_function(structure: Any) -> ForwardFunction:
        def compile_jacobian(jacobian: ForwardFunction, argnums_by_order: tuple) -> ForwardFunction:
            if make_column_function is None or len(argnums_by_order) > 1:
                return jacobian
            compute_columns = make_column_function(structure, *argnums_by_order)

            def compute_jacobian(*leaves: Array) -> tuple:
                columns, float_outputs, nonfloat_outputs = compute_columns(*leaves)
                return (columns, float_outputs), nonfloat_outputs

            return compute_jacobian

        return enable_all_ad_modes(
            make_leaf_function(function, structure),
            make_leaf_function(reference, structure),
            compile_jacobian,
        )

    def call_differentiable_function(*arguments: PyTree) -> PyTree:
        leaves, structure = jax.tree.flatten(arguments)
        return eqx.combine(*differentiate_leaf_function(structure)(*leaves))

    return call_differentiable_function


def make_leaf_function(function: Callable, structure: Any) -> ForwardFunction:
    """Return a function of the leaves of arguments with a tree structure.

    Its results are divided into floating-point arrays and other arrays.
    """
    return lambda *leaves: eqx.partition(
        function(*jax.tree.unflatten(structure, leaves)), eqx.is_inexact_array
    )


def compute_jacobian_columns(
    function: Callable,
    argument_leaves: Sequence[Array],
    input_indices: Sequence[int],
    has_lanes: bool = True,
    n_directions_at_once: int | None = None,
) -> tuple:
    """Return the Jacobian columns, the float results and all other results of a function.

    The columns are derivatives with respect to the leaves at `input_indices`. The leading axis of
    the columns runs over the entries of the leaves. `function` returns float arrays, and auxiliary
    results. If `has_lanes` is true, the last axis of all arrays is the batch.

    - `n_directions_at_once`: number of columns that code without a loop computes. More columns are
      computed in a loop, which repeats the function, so that the code stays short.
    """

    def evaluate_at_selected_leaves(*selected_leaf_values: Array) -> tuple:
        all_leaves = list(argument_leaves)
        for i, selected_leaf_value in zip(input_indices, selected_leaf_values, strict=True):
            all_leaves[i] = selected_leaf_value
        return function(*all_leaves)

    selected_leaves = [argument_leaves[i] for i in input_indices]
    n_lane_axes = int(has_lanes)
    n_entries_by_leaf = [math.prod(x.shape[: x.ndim - n_lane_axes]) for x in selected_leaves]
    n_vectors = sum(n_entries_by_leaf)
    # Each entry of a unit vector is a separate constant 0 or 1, so that machine code omits products
    # with 0.
    unit_vectors, unit_tangents = iter(np.eye(n_vectors)), []
    for leaf, n_entries in zip(selected_leaves, n_entries_by_leaf, strict=True):
        lane_shape = leaf.shape[leaf.ndim - n_lane_axes :]
        tangents = [
            jnp.broadcast_to(
                jnp.asarray(next(unit_vectors), leaf.dtype).reshape(-1, *(1,) * n_lane_axes),
                (n_vectors, *lane_shape),
            )
            for _ in range(n_entries)
        ]
        if leaf.ndim > n_lane_axes:
            tangents = [jnp.stack(tangents, 1).reshape(n_vectors, *leaf.shape)]
        unit_tangents += tangents
    differentiate = lambda tangents: jax.jvp(
        evaluate_at_selected_leaves, selected_leaves, tangents, has_aux=True
    )
    differentiate_in_directions = jax.vmap(
        differentiate, out_axes=(None, 0, None), axis_name=_DIRECTIONS_AXIS
    )
    if not n_directions_at_once or n_vectors <= n_directions_at_once:
        float_outputs, jacobian_columns, nonfloat_outputs = differentiate_in_directions(
            unit_tangents
        )
        return jacobian_columns, float_outputs, nonfloat_outputs
    n_rounds = -(-n_vectors // n_directions_at_once)
    n_absent = n_rounds * n_directions_at_once - n_vectors
    rounds = [
        jnp.concatenate([x, jnp.zeros((n_absent, *x.shape[1:]), x.dtype)]).reshape(
            n_rounds, n_directions_at_once, *x.shape[1:]
        )
        for x in unit_tangents
    ]
    outputs, columns, other_outputs = lax.map(differentiate_in_directions, rounds)
    float_outputs, nonfloat_outputs = jax.tree.map(lambda x: x[-1], (outputs, other_outputs))
    jacobian_columns = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:n_vectors], columns)
    return jacobian_columns, float_outputs, nonfloat_outputs


@jax.jit
def _apply_columns(columns: PyTree, tangents: Sequence[Array]) -> PyTree:
    """Return the sum over columns of a Jacobian times entries of tangents, leaf by leaf.

    Products are written as sums, because a matrix product of small arrays is a library call.
    """
    weights = jnp.concatenate([jnp.ravel(x) for x in tangents])
    return jax.tree.map(
        lambda x: jnp.sum(x * weights.reshape(-1, *(1,) * (x.ndim - 1)), 0, x.dtype), columns
    )


_DIRECTIONS_AXIS = "directions of vrw_jax"  # no name that a user has for an axis


def find_maximum_over_directions(x: Array) -> Array:
    """Return the maximum over all directions that `compute_jacobian_columns` computes together.

    JVP rules call it for values that all directions share. Outside of that function, directions are
    unknown, and the result is zero.
    """
    try:
        return jnp.max(lax.all_gather(x, _DIRECTIONS_AXIS), axis=0)
    except NameError:  # The axis does not exist.
        return jnp.zeros_like(x)


ExecutionWrapper = Callable[[BatchFunction, int], BatchFunction]
"""Function that determines how a batch function is executed, given the order of its derivative."""


def with_implicit_derivative(
    function: BatchFunction,
    compute_tangents: Callable,
    execution_wrapper: ExecutionWrapper,
    derivative_order: int = 0,
) -> Callable:
    """Return `function(p, z)` for one wheel, differentiable on the branch z = z(p).

    The result is differentiable to any order and in any mode. `function(p, z)` itself acts on a
    batch. `compute_tangents(p, z)` returns dz/dp for one wheel, with a leading axis over p. Its
    result is correct if z = z(p), and it must be a function that `with_implicit_derivative` has
    returned. The derivative rule returns the total derivative with respect to p times the tangent
    of p. The rule ignores the tangent of z, because that can only be dz/dp times the tangent of p.
    """
    wrapped_function = jax.custom_jvp(unbatch(execution_wrapper(function, derivative_order)))

    @wrapped_function.defjvp
    @with_default_jax_settings
    def compute_function_jvp(primals: tuple, tangents: tuple) -> tuple:
        jacobian = make_implicit_jacobian(
            function, compute_tangents, execution_wrapper, derivative_order + 1
        )(*primals)
        return wrapped_function(*primals), apply_jacobian(jacobian, tangents[0])

    return wrapped_function


def make_implicit_jacobian(
    function: BatchFunction,
    compute_tangents: Callable,
    execution_wrapper: ExecutionWrapper,
    derivative_order: int = 1,
    make_jacobian: BatchFunction | None = None,
) -> Callable:
    """Return a function that computes d function(p, z(p)) / dp, with a leading axis over p.

    The returned function is differentiable like that of `with_implicit_derivative`. If
    `make_jacobian` is given, `make_jacobian(p, (z, dz/dp))` replaces the default computation of the
    Jacobian by a faster one.
    """

    def compute_jvps_sequentially(p: Array, z_and_jacobian: tuple[PyTree, PyTree]) -> PyTree:
        """Return the derivatives for a batch, computed one direction after another.

        The compiled code is then as short as for one direction.
        """
        n_parameters, (z, z_jacobian) = p.shape[0], z_and_jacobian
        unit_tangents = jnp.broadcast_to(
            jnp.eye(n_parameters, dtype=p.dtype)[:, :, None], (n_parameters, *p.shape)
        )
        return lax.map(
            lambda tangent: jax.jvp(function, (p, z), tangent)[1], (unit_tangents, z_jacobian)
        )

    def compute_branch_tangents(
        p: Array, z_and_jacobian: tuple[PyTree, PyTree]
    ) -> tuple[PyTree, PyTree]:
        z, z_jacobian = z_and_jacobian
        second_derivatives = jax.jacfwd(compute_tangents)(p, z)
        return z_jacobian, jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), second_derivatives)

    jacobian_function = with_implicit_derivative(
        make_jacobian or compute_jvps_sequentially,
        compute_branch_tangents,
        execution_wrapper,
        derivative_order,
    )
    return lambda p, z: jacobian_function(p, lax.stop_gradient((z, compute_tangents(p, z))))


def evaluate_with_jacobian(function: Callable, *arguments: Array) -> tuple[Any, Any]:
    """Return the outputs of `function` and the derivatives of its float outputs.

    One program computes the outputs and the derivatives. The last axes of a derivative are those of
    an argument. If there are several arguments, the derivative of each output leaf is a tuple with
    one entry per argument.
    """

    def evaluate_parts(*arrays: Any) -> tuple[PyTree, tuple]:
        outputs = eqx.partition(function(*arrays), eqx.is_inexact_array)
        return outputs[0], outputs

    argnums = tuple(range(len(arguments))) if len(arguments) > 1 else 0
    jacobian, outputs = jax.jacfwd(evaluate_parts, argnums, has_aux=True)(*arguments)
    return eqx.combine(*outputs), jacobian


def apply_jacobian(jacobian: PyTree, tangent: Array) -> PyTree:
    """Return the product of the Jacobian and the tangent, leaf by leaf.

    The leading axis of each Jacobian leaf runs over inputs.
    """
    return jax.tree.map(lambda jacobian_leaf: jnp.tensordot(tangent, jacobian_leaf, 1), jacobian)


def make_zero_tangent(tree: PyTree) -> PyTree:
    """Return the zero tangent for a tree of outputs.

    Leaves for outputs that are not floats have the type float0.
    """
    make_zero_leaf_tangent = lambda x: (
        jnp.zeros_like(x)
        if jnp.issubdtype(jnp.result_type(x), jnp.inexact)
        else np.zeros(jnp.shape(x), jax.dtypes.float0)
    )
    return jax.tree.map(make_zero_leaf_tangent, tree)


def compute_square_root(x: Array) -> Array:
    """Return the square root of max(x, 0). Its derivative is zero for x <= 0."""
    is_argument_positive = x > 0.0
    return jnp.where(is_argument_positive, jnp.sqrt(jnp.where(is_argument_positive, x, 1.0)), 0.0)


def apply_batched_jvp_rule(
    evaluate_jvp_rule: Callable[[Any, Any], tuple[Any, Any]], primals: Any, tangents: Any
) -> tuple[Any, Any]:
    """Return the values and tangents of a JVP rule that computes all directions of a vmap together.

    - `evaluate_jvp_rule`: function of primals and tangents that returns the values and their
      tangents. The first axis of its tangents contains the directions. The length of this axis is 1
      if all directions have the same tangents;
    - `primals`, `tangents`: arguments of the JVP rule, without an axis of directions.
    """
    leaves, tree_structure = jax.tree.flatten((primals, tangents))
    n_primal_leaves = len(jax.tree.leaves(primals))
    n_directions = len(_count_vmapped_directions(tangents))
    if n_directions == 0:
        function_values, output_tangents = evaluate_jvp_rule(
            primals, jax.tree.map(lambda x: x[None], tangents)
        )
        return function_values, jax.tree.map(lambda x: x[0], output_tangents)
    output_structure: Any = None

    def evaluate_batched_jvp_rule(leaves: Any, axes: Any) -> tuple[list, list]:
        nonlocal output_structure
        if any(leaf_axis is not None for leaf_axis in axes[:n_primal_leaves]):
            raise NotImplementedError(
                "jax.vmap around a derivative of lanes maps its directions only: put batches of "
                "values on the lanes' axis, the last one."
            )
        leaves_and_axes = zip(leaves[n_primal_leaves:], axes[n_primal_leaves:], strict=True)
        direction_leaves = [
            x[None] if leaf_axis is None else jnp.moveaxis(x, leaf_axis, 0)
            for x, leaf_axis in leaves_and_axes
        ]
        function_values, output_tangents = evaluate_jvp_rule(
            *jax.tree.unflatten(tree_structure, [*leaves[:n_primal_leaves], *direction_leaves])
        )
        output_tangents = jax.tree.map(
            lambda x: jnp.broadcast_to(x, (n_directions, *x.shape[1:])), output_tangents
        )
        flat_results, output_structure = jax.tree.flatten((function_values, output_tangents))
        n_function_values = len(jax.tree.leaves(function_values))
        return flat_results, [None] * n_function_values + [0] * (
            len(flat_results) - n_function_values
        )

    flat_results = _HOIST_OUT_OF_VMAP_PRIMITIVE.bind(
        *leaves, map_over_axes=evaluate_batched_jvp_rule
    )
    return jax.tree.unflatten(output_structure, flat_results)


@custom_vmap
def _count_vmapped_directions(_: Any) -> Array:
    """Return zeros whose length is the number of directions in an enclosing `jax.vmap`.

    Without such a vmap, the array is empty.
    """
    return jnp.zeros(0)


@_count_vmapped_directions.def_vmap
@with_default_jax_settings
def _count_vmapped_directions_rule(n_directions: int, _: list, _tangent: Any) -> tuple[Array, bool]:
    return jnp.zeros(n_directions), False


_HOIST_OUT_OF_VMAP_PRIMITIVE = Primitive("beyond")


_HOIST_OUT_OF_VMAP_PRIMITIVE.multiple_results = True


batching.primitive_batchers[_HOIST_OUT_OF_VMAP_PRIMITIVE] = lambda values, axes, map_over_axes: (
    map_over_axes(values, axes)
)
"""Primitive whose function is traced outside of the enclosing `jax.vmap`, which would trace its
loops again.
"""


def map_directions(
    evaluate_for_direction: Callable[[Any], Any], directions: Any, is_unrolled: bool = False
) -> Any:
    """Return the results of a function for all directions.

    They are computed in a loop, which makes the values for one direction fit into registers. With
    `is_unrolled` there is no loop, so that the compiler removes entries that are known to be zero.
    """
    varying_tangents, shared_tangents = eqx.partition(directions, lambda x: len(x) > 1)
    shared_tangents = jax.tree.map(lambda x: x[0], shared_tangents)
    evaluate_varying = lambda tangents: evaluate_for_direction(
        eqx.combine(tangents, shared_tangents)
    )
    if not jax.tree.leaves(varying_tangents):
        return jax.tree.map(lambda x: x[None], evaluate_varying(varying_tangents))
    if is_unrolled:
        return jax.vmap(evaluate_varying)(varying_tangents)
    return lax.map(evaluate_varying, varying_tangents)


def compute_each_jvp(function: Callable[..., Any], primals: tuple, directions: tuple) -> Any:
    """Return the tangents of a function's result for all directions, computed with `jax.jvp`.

    The program is as short as for one direction.
    """
    return map_directions(lambda direction: jax.jvp(function, primals, direction)[1], directions)


def with_batched_jvp(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return `function` with a JVP rule that computes the tangents of all directions together.

    The values are those of `function`. The rule differentiates with respect to all floating-point
    arrays among the arguments.
    """

    def call_with_batched_jvp(*arguments: Any) -> Any:
        float_arguments, nonfloat_arguments = eqx.partition(arguments, eqx.is_inexact_array)
        evaluate_with_float_arguments = lambda *float_arguments: function(
            *eqx.combine(float_arguments, nonfloat_arguments)
        )
        evaluate_float_results = lambda *float_arguments: eqx.filter(
            evaluate_with_float_arguments(*float_arguments), eqx.is_inexact_array
        )
        differentiable_function = jax.custom_jvp(evaluate_with_float_arguments)

        @differentiable_function.defjvp
        @with_default_jax_settings
        def evaluate_float_jvp(primals: tuple, tangent: tuple) -> tuple:
            evaluate_with_tangents = lambda primals, directions: (
                evaluate_with_float_arguments(*primals),
                compute_each_jvp(evaluate_float_results, primals, directions),
            )
            function_outputs, float_tangents = apply_batched_jvp_rule(
                evaluate_with_tangents, primals, tangent
            )
            return function_outputs, eqx.combine(
                float_tangents, make_zero_tangent(function_outputs)
            )

        return differentiable_function(*float_arguments)

    return call_with_batched_jvp


_FORWARD_ONLY_PRIMITIVE = Primitive("forward_only")
"""Identity operation whose transpose raises an error."""


def _raise_reverse_mode_error(_cotangent: Any, _value: Any, *, function_name: str) -> None:
    """Raise a ValueError that explains why reverse mode is not available."""
    raise ValueError(
        f"{function_name} has no derivative in reverse mode, since the number of its solver "
        "steps is not known beforehand: use forward mode, jax.jacfwd or jax.jvp, instead of "
        "jax.grad, jax.jacrev or jax.vjp."
    )


_FORWARD_ONLY_PRIMITIVE.def_impl(lambda x, *, function_name: x)


_FORWARD_ONLY_PRIMITIVE.def_abstract_eval(lambda x, *, function_name: x)


ad.deflinear2(_FORWARD_ONLY_PRIMITIVE, _raise_reverse_mode_error)


batching.defvectorized(_FORWARD_ONLY_PRIMITIVE)


mlir.register_lowering(_FORWARD_ONLY_PRIMITIVE, lambda _context, x, *, function_name: [x])


def forbid_reverse_mode(function_name: str, function_result: PyTree) -> PyTree:
    """Return `function_result` unchanged, marked so that reverse-mode differentiation raises an
    error.

    `function_name` is the function that computed the result. Inside `lanes.jit` there is no mark,
    because reverse mode transposes the derivatives that machine code computes.
    """
    if targets_machine_code():
        return function_result

    def mark_leaf_as_forward_only(leaf: Any) -> Any:
        if isinstance(leaf, jax.core.Tracer) and eqx.is_inexact_array(leaf):
            return _FORWARD_ONLY_PRIMITIVE.bind(leaf, function_name=function_name)
        return leaf

    return jax.tree.map(mark_leaf_as_forward_only, function_result)
