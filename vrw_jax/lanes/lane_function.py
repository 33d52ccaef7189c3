"""Compilation of functions for batches: machine code on CPUs, XLA elsewhere.

`jit` compiles a function of one lane (one element of a batch). `compile_batch_function` compiles a
function that is already written for arrays with lanes on their last axis.
"""

import contextlib
import functools
import warnings
from collections import OrderedDict
from collections.abc import Callable, Sequence
from itertools import compress
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from vrw_jax.lanes import environment, program
from vrw_jax.lanes.array_emitter import MAX_UNROLLED_ENTRIES, LaneAxisError
from vrw_jax.lanes.autodiff import enable_all_ad_modes
from vrw_jax.lanes.batching import (
    BatchFunction,
    append_lane_axis,
    apply_function_in_blocks,
    unbatch,
)
from vrw_jax.lanes.environment import with_default_jax_settings
from vrw_jax.lanes.keys import (
    UnresolvableFunctionError,
    lift_numbers,
    make_key,
    make_key_with_origin,
    make_placeholder,
)
from vrw_jax.lanes.machine_code import LaneProgram, get_lane_program, targets_machine_code
from vrw_jax.lanes.program import (
    ArgumentTypes,
    call_machine_code,
    is_machine_code_available,
    make_argument_shapes,
    run_machine_code,
    wrap_with_saved_trace,
)

STRAGGLER_COUNT_DIVISOR = 8
"""Ratio of the block size to the number of unfinished lanes at which an XLA program stops.

The program then runs again for the unfinished lanes of all blocks together. The value is chosen
because a block with fewer unfinished lanes wastes most of its work.
"""

MAX_COMPILED_FUNCTIONS = 64
"""Largest number of argument structures and closures for which one function stays compiled."""

N_DIRECTIONS_AT_ONCE = 4
"""Number of columns of a Jacobian that code without a loop computes.

The value is chosen because a walker with twelve columns then compiles in a third of the time of
code without a loop, and runs as fast as with more columns.
"""

MAX_SHARED_ENTRIES = 64
"""Largest array that lanes share as separate numbers; larger arrays are repeated for each lane."""


class CompiledBatchFunction:
    """Function of trees of arrays with lanes on the last axis, compiled at its first call.

    JAX programs call the object itself, which uses one core. `run` takes NumPy arrays and uses all
    cores. Neither has derivatives.
    """

    def __init__(
        self,
        function: BatchFunction,
        xla_block_size: int,
        max_unrolled_entries: int = MAX_UNROLLED_ENTRIES,
        marks_unfinished_lanes: bool = False,
        key: str | Literal["by content"] | None = "by content",
    ) -> None:
        self._function = function
        self._xla_block_size = xla_block_size
        self._max_unrolled_entries = max_unrolled_entries
        self._marks_unfinished_lanes = marks_unfinished_lanes
        self._lasting_key = key
        self._programs: dict[Any, LaneProgram] = {}

    def __call__(self, *argument_trees: Any) -> Any:
        """Return the results as part of the JAX program that calls this object."""
        if self._has_machine_code():
            leaves, structure = jax.tree.flatten(argument_trees)
            leaves = [x if hasattr(x, "dtype") else jnp.asarray(x) for x in leaves]

            def replace_code(compilation_error: Exception) -> Callable:
                self._use_xla_after(compilation_error)
                return lambda *leaves: jax.tree.leaves(
                    self._call_by_xla(*jax.tree.unflatten(structure, leaves))
                )

            get_program = functools.partial(self._get_program, structure)
            with contextlib.suppress(_NoMachineCodeError):
                return call_machine_code(get_program, leaves, replace_code)
        return self._call_by_xla(*argument_trees)

    def _call_by_xla(self, *argument_trees: Any) -> Any:
        blockwise_function = apply_function_in_blocks(self._function, self._xla_block_size)
        return wrap_with_saved_trace(blockwise_function, self._find_key)(*argument_trees)

    def run(self, *argument_trees: Any) -> Any:
        """Return the results for NumPy arrays, as NumPy arrays, computed on all cores.

        Arrays without axes are the same for all lanes.
        """
        leaves, structure = jax.tree.flatten(argument_trees)
        leaves = [np.asarray(x) for x in leaves]
        flat_function = functools.partial(_call_with_leaves, self._function, structure)
        if self._has_machine_code():
            with contextlib.suppress(_NoMachineCodeError):
                return run_machine_code(functools.partial(self._get_program, structure), leaves)
        # Each program is traced once, while the function has the values of the key.
        argument_types = [(x.shape[:-1] if x.ndim else None, x.dtype) for x in leaves]
        program_key = self._find_key(structure, argument_types)
        xla_program = _xla_programs.get(program_key, jax.jit(flat_function))
        if program_key:
            _xla_programs[program_key] = xla_program
        if next(x.shape[-1] for x in leaves if x.ndim) == 0:
            one_lane = [
                jax.ShapeDtypeStruct((*x.shape[:-1], 1) if x.ndim else (), x.dtype) for x in leaves
            ]
            make_empty = lambda x: np.empty((*x.shape[:-1], 0), x.dtype)
            return jax.tree.map(make_empty, jax.eval_shape(xla_program, *one_lane))
        return _run_by_blocks(
            xla_program,
            self._xla_block_size,
            self._marks_unfinished_lanes,
            leaves,
        )

    def _get_program(
        self, structure: Any, argument_types: ArgumentTypes, numbers_of_lanes: Sequence[int]
    ) -> LaneProgram:
        """Return the program for arguments of a structure, see `get_lane_program`.

        Raise a `_NoMachineCodeError` if XLA has to compute the function. The code of one lane is
        compiled later, so its errors appear in `LaneCall.lower`.
        """
        trace_environment = environment.describe_trace_environment()
        make_signature = lambda n: (structure, argument_types, n, trace_environment)
        for signature in map(make_signature, numbers_of_lanes):
            if signature in self._programs:
                return self._programs[signature]
        try:
            lane_program = get_lane_program(
                functools.partial(_call_with_leaves, self._function, structure),
                make_argument_shapes(argument_types),
                self._find_key(structure),
                numbers_of_lanes,
                self._max_unrolled_entries,
            )
            if (
                lane_program.lanes_per_group > 1
            ):  # JAX may still map the call for one lane over a batch.
                lane_program.machine_code  # noqa: B018, starts the compilation
        except Exception as compilation_error:
            self._use_xla_after(compilation_error)
            raise _NoMachineCodeError from compilation_error
        if self._lasting_key not in (None, "by content"):
            self._programs[make_signature(lane_program.lanes_per_group)] = lane_program
        return lane_program

    def _find_key(self, *further_values: Any) -> str | None:
        """Return the key of the function, or None if it has none."""
        if self._lasting_key is None:
            return None
        if self._lasting_key == "by content":
            try:
                key, is_lasting = make_key_with_origin(self._function)
            except UnresolvableFunctionError:
                return None
            if not is_lasting:
                return make_key(key, *further_values)
            self._lasting_key = key
        return make_key(self._lasting_key, *further_values)

    def _has_machine_code(self) -> bool:
        return is_machine_code_available() and not (
            _keys_without_machine_code and self._find_key() in _keys_without_machine_code
        )

    def _use_xla_after(self, compilation_error: Exception) -> None:
        """Note that XLA computes this function, with one warning, or raise an unexpected error."""
        if isinstance(compilation_error, LaneAxisError):
            raise compilation_error
        if isinstance(compilation_error, NotImplementedError):
            key = self._find_key()
            if key is not None:
                _keys_without_machine_code.add(key)
            name = getattr(self._function, "__qualname__", "a function")
            warnings.warn(f"XLA computes {name}, more slowly: {compilation_error}", stacklevel=4)
        elif program.is_tested_jax_release():
            raise compilation_error
        else:
            program.disable_machine_code(compilation_error)


class _NoMachineCodeError(Exception):
    """Error of a function that machine code cannot compute, so that XLA does."""


_keys_without_machine_code: set[str | None] = set()
"""Keys of functions that contain a primitive without machine code."""
_xla_programs: dict[str | None, Callable] = {}
"""Functions that XLA compiles for calls with NumPy arrays, by their keys."""


def compile_batch_function(
    function: BatchFunction,
    xla_block_size: int = 1,
    max_unrolled_entries: int = MAX_UNROLLED_ENTRIES,
    marks_unfinished_lanes: bool = False,
) -> CompiledBatchFunction:
    """Compile a function of trees of arrays with lanes on the last axis, at its first call.

    The function must be elementwise over lanes, except for loops that end when no lane continues.
    The disk cache keeps the code under a key of the function's own code and closure.

    - `xla_block_size`: number of lanes that one call of an XLA program computes;
    - `max_unrolled_entries`: largest array whose entries each have instructions of their own;
    - `marks_unfinished_lanes`: whether an XLA program of `run` may stop while a few lanes are
      unfinished. The function then takes the number of these lanes as a further argument, and its
      first result is a boolean array that marks them.
    """
    return CompiledBatchFunction(
        function, xla_block_size, max_unrolled_entries, marks_unfinished_lanes
    )


def jit_batch(
    function: BatchFunction, max_unrolled_entries: int = MAX_UNROLLED_ENTRIES
) -> BatchFunction:
    """Compile a function of trees of arrays with lanes on the last axis, as a function of one lane.

    `jax.vmap` of the result calls the compiled function once. The result has no derivatives.
    """
    return unbatch(compile_batch_function(function, max_unrolled_entries=max_unrolled_entries))


def _call_with_leaves(function: Callable, structure: Any, *leaves: Any) -> Any:
    """Return `function(*trees)` for the leaves of the trees, and further arguments after them."""
    n_leaves = structure.num_leaves
    return function(*jax.tree.unflatten(structure, leaves[:n_leaves]), *leaves[n_leaves:])


def _run_by_blocks(
    xla_program: Callable,
    block_size: int,
    marks_unfinished_lanes: bool,
    leaves: Sequence[np.ndarray],
) -> Any:
    """Return the results of an XLA program that runs for one block of lanes after another.

    The program then runs again for the unfinished lanes of all blocks together.
    """
    n_lanes = next(x.shape[-1] for x in leaves if x.ndim)
    results: list[np.ndarray] = []
    unfinished_lanes = np.arange(n_lanes)
    while len(unfinished_lanes) > 0:
        is_last_round = len(unfinished_lanes) <= block_size
        straggler_count = np.int32(0 if is_last_round else block_size // STRAGGLER_COUNT_DIVISOR)
        straggler_lanes = []
        for block_start in range(0, len(unfinished_lanes), block_size):
            block_lanes = unfinished_lanes[block_start : block_start + block_size]
            n_block_lanes = len(block_lanes)
            padded_lanes = np.pad(block_lanes, (0, block_size - n_block_lanes), "edge")
            block_results = xla_program(
                *(x[..., padded_lanes] if x.ndim else x for x in leaves),
                *[straggler_count] * marks_unfinished_lanes,
            )
            result_leaves, result_structure = jax.tree.flatten(block_results)
            block_outputs = [np.asarray(x)[..., :n_block_lanes] for x in result_leaves]
            results = results or [
                np.empty((*x.shape[:-1], n_lanes), x.dtype) for x in block_outputs
            ]
            is_finished = (
                ~block_outputs[0] if marks_unfinished_lanes else np.ones(n_block_lanes, bool)
            )
            for result, block_output in zip(results, block_outputs, strict=True):
                result[..., block_lanes[is_finished]] = block_output[..., is_finished]
            straggler_lanes.append(block_lanes[~is_finished])
        unfinished_lanes = np.concatenate(straggler_lanes)
    return jax.tree.unflatten(result_structure, results)


def jit(function: Callable[..., PyTree], *, xla_block_size: int = 1024) -> "LaneFunction":
    """Compile a function of one lane, so that batches of it run fast on CPUs.

    Use it where one call does little and batches have thousands of elements, above all if each
    element takes its own number of loop iterations. `jax.jit(jax.vmap(f))` runs a loop until the
    slowest element ends, and stores intermediate results in memory. Machine code computes a few
    elements at a time in vector registers, and each such group ends by itself. If the function
    contains a JAX primitive without machine code, XLA computes it, with one warning.

    Args:
        function: JAX function of pytrees of numbers and arrays, written for one element. Other
            leaves, such as strings and functions, are static.
        xla_block_size: number of elements that one call of an XLA program computes, where XLA
            replaces machine code.

    Returns:
        A `LaneFunction`, called with the arguments of `function`, by position. `jax.vmap`, `jit`,
        `grad`, `jacfwd`, `jacrev` and `hessian` apply to it. Its method `batch` uses all cores.

    Examples:
        >>> square_root = lanes.jit(lambda x: jnp.sqrt(x))
        >>> square_root.batch(np.array([1.0, 4.0])).tolist()
        [1.0, 2.0]
    """
    return LaneFunction(function, xla_block_size)


class LaneFunction:
    """Function of one lane that `jit` has compiled.

    Other values of the numbers in its closure compile nothing anew. If other values in its closure
    or global names change, the next call compiles the function with the new values.
    """

    def __init__(self, function: Callable, xla_block_size: int) -> None:
        functools.update_wrapper(self, function)
        self._function = function
        self._xla_block_size = xla_block_size
        self._variants: OrderedDict[str, _LaneFunctionVariant] = OrderedDict()
        self._keys_with_fixed_numbers: set[str] = set()

    @with_default_jax_settings
    def __call__(self, *arguments: Any) -> Any:
        """Return the result for one lane."""
        if targets_machine_code():
            return self._function(*arguments)
        return self._evaluate(arguments, lambda variant, arrays: variant.call(arrays))

    @with_default_jax_settings
    def batch(self, *arguments: Any, in_axes: Any = 0) -> Any:
        """Return the results for a batch as NumPy arrays, with the batch on their first axis.

        All cores of the process compute. The results of an element are bitwise the same in any
        batch.

        Args:
            *arguments: arguments of the function, as arrays with the batch on their first axis.
            in_axes: 0 for arguments with a batch axis and None for others: one for all arguments,
                or one for each argument or its parts, as in `jax.vmap`.
        """
        if not isinstance(in_axes, list | tuple):
            in_axes = (in_axes,) * len(arguments)
        axes: list[int | None] = []
        try:
            jax.tree.map(
                lambda axis, tree: axes.extend([axis] * len(jax.tree.leaves(tree))),
                tuple(in_axes),
                arguments,
                is_leaf=lambda axis: axis is None,
            )
        except ValueError:
            raise ValueError(
                f"in_axes is {in_axes}, but it does not fit to the {len(arguments)} arguments: "
                "give 0 or None for each argument."
            ) from None
        return self._evaluate(arguments, lambda variant, arrays: variant.run_batch(arrays, axes))

    def _evaluate(self, arguments: tuple, evaluate: Callable) -> Any:
        """Return the result of `evaluate` for the compiled variant and the arrays of a call."""
        leaves, structure = jax.tree.flatten(arguments)
        is_array = tuple(isinstance(x, ARRAY_TYPES) for x in leaves)
        static_leaves = [None if flag else x for x, flag in zip(leaves, is_array, strict=True)]
        arrays = [x for x, flag in zip(leaves, is_array, strict=True) if flag]
        signature = structure, static_leaves, is_array
        numbers, rebuild = lift_numbers(self._function)
        if numbers:
            key = _find_key(rebuild([make_placeholder(x) for x in numbers]), *signature)
            if key not in self._keys_with_fixed_numbers:
                try:
                    variant = self._find_variant(key, signature, len(numbers), rebuild)
                    return evaluate(variant, _convert_numbers([*numbers, *arrays]))
                except NUMBER_ERRORS:
                    # Python decides by a number of the closure, so the code depends on its value.
                    if key is None or any(isinstance(x, jax.core.Tracer) for x in numbers):
                        raise
                    self._keys_with_fixed_numbers.add(key)
        key = _find_key(self._function, *signature)
        variant = self._find_variant(key, signature, 0, lambda _: self._function)
        return evaluate(variant, _convert_numbers(arrays))

    def _find_variant(
        self, key: str | None, signature: tuple, n_numbers: int, rebuild: Callable
    ) -> "_LaneFunctionVariant":
        variant = self._variants.get(key) if key else None
        if variant is None:
            name = getattr(self._function, "__qualname__", "a function")
            variant = _LaneFunctionVariant(name, self._xla_block_size, key, signature, n_numbers)
        if key:
            self._variants[key] = variant
            self._variants.move_to_end(key)
            if len(self._variants) > MAX_COMPILED_FUNCTIONS:
                self._variants.popitem(last=False)
        variant.rebuild_function = rebuild  # An earlier function may have changed since.
        return variant


class _LaneFunctionVariant:
    """Compiled function of one lane, for one structure of arguments and one closure.

    Its arguments are numbers of the closure, and then the arrays among the arguments.
    """

    rebuild_function: Callable

    def __init__(
        self, name: str, xla_block_size: int, key: str | None, signature: tuple, n_numbers: int
    ) -> None:
        self._name, self._xla_block_size, self._key = name, xla_block_size, key
        self._structure, self._static_leaves, self._is_array = signature
        self._n_numbers = n_numbers
        self._batch_functions: dict[Any, CompiledBatchFunction] = {}
        self._call_one_lane = enable_all_ad_modes(
            self._compile(self._evaluate_parts, ()),
            self._evaluate_parts,
            compile_jacobian=self._compile,
            n_directions_at_once=N_DIRECTIONS_AT_ONCE,
        )

    def call(self, arrays: Sequence[Any]) -> Any:
        return eqx.combine(*self._call_one_lane(*arrays))

    def run_batch(self, arrays: Sequence[Any], axes: Sequence[int | None]) -> Any:
        axes = (*[None] * self._n_numbers, *compress(axes, self._is_array))
        arrays = list(map(np.asarray, arrays))
        sizes: set[Any] = {
            len(x) if x.ndim else "one number"
            for x, axis in zip(arrays, axes, strict=True)
            if axis == 0
        }
        if set(axes) - {0, None} or len(sizes) != 1 or "one number" in sizes:
            raise ValueError(
                f"in_axes is {axes[self._n_numbers :]} and batches have the lengths "
                f"{sorted(sizes, key=str)}: give 0 or None for each argument, and batches as "
                "arrays of one length."
            )
        (n_lanes,) = sizes
        shared: list[Any] = []
        with_lanes: list[np.ndarray] = []
        shared_shapes: tuple[tuple[int, ...] | None, ...] = ()
        for x, axis in zip(arrays, axes, strict=True):
            is_shared = axis is None and x.size <= MAX_SHARED_ENTRIES
            shared_shapes += (x.shape if is_shared else None,)
            if is_shared:
                shared += list(x.ravel())
                continue
            repeat = lambda x: np.broadcast_to(x[..., None], (*x.shape, n_lanes))
            x = np.moveaxis(x, 0, -1) if axis == 0 else repeat(x)
            with_lanes.append(np.ascontiguousarray(x))
        if shared_shapes not in self._batch_functions:
            self._batch_functions[shared_shapes] = self._compile_for_batches(shared_shapes)
        results = self._batch_functions[shared_shapes].run(shared, *with_lanes)
        return jax.tree.map(lambda x: np.moveaxis(x, -1, 0), results)

    def _evaluate(self, *arrays: Any) -> Any:
        """Return the result of the user's function for one lane."""
        numbers, arguments = arrays[: self._n_numbers], iter(arrays[self._n_numbers :])
        leaves = [
            next(arguments) if flag else static
            for flag, static in zip(self._is_array, self._static_leaves, strict=True)
        ]
        return self.rebuild_function(numbers)(*jax.tree.unflatten(self._structure, leaves))

    def _evaluate_parts(self, *arrays: Any) -> tuple[Any, Any]:
        result = jax.tree.map(jnp.asarray, self._evaluate(*arrays))
        return eqx.partition(result, eqx.is_inexact_array)

    def _compile(self, function: Callable, differentiated_arguments: tuple) -> Callable:
        """Compile a function of the arrays of one lane, which `jax.vmap` maps to lanes."""
        key = self._key and make_key(self._key, "one lane", differentiated_arguments)
        lane_function = with_lane_axis(function, 0, self._name)
        return unbatch(CompiledBatchFunction(lane_function, self._xla_block_size, key=key))

    def _compile_for_batches(
        self, shared_shapes: tuple[tuple[int, ...] | None, ...]
    ) -> CompiledBatchFunction:
        """Compile a function of shared numbers and of arrays with lanes on the last axis."""

        def evaluate_assembled(shared: Sequence[Any], *lane_arrays: Any) -> Any:
            entries, arrays = iter(shared), iter(lane_arrays)
            assembled = [
                next(arrays)
                if shape is None
                else jnp.reshape(
                    jnp.stack([next(entries) for _ in range(int(np.prod(shape)))]), shape
                )
                if shape
                else next(entries)
                for shape in shared_shapes
            ]
            return jax.tree.map(jnp.asarray, self._evaluate(*assembled))

        key = self._key and make_key(self._key, "batches", shared_shapes)
        return CompiledBatchFunction(
            with_lane_axis(evaluate_assembled, 1, self._name), self._xla_block_size, key=key
        )


ARRAY_TYPES = (jax.Array, np.ndarray, np.generic, bool, int, float, complex)
"""Types of arguments that are traced; others are static."""
NUMBER_ERRORS = (TypeError, AttributeError)
"""Errors of code that needs a number while JAX traces it: its value, its hash or its methods."""


def _find_key(*values: Any) -> str | None:
    try:
        return make_key(*values)
    except UnresolvableFunctionError:
        return None


def _convert_numbers(arrays: Sequence[Any]) -> list[Any]:
    """Return arrays, where Python floats have the floating-point type of the other arrays."""
    dtypes = [
        x.dtype for x in arrays if hasattr(x, "dtype") and jnp.issubdtype(x.dtype, jnp.floating)
    ]
    dtype = jnp.result_type(*dtypes) if dtypes else jnp.zeros(()).dtype
    return [jnp.asarray(x, dtype) if isinstance(x, float) else jnp.asarray(x) for x in arrays]


def with_lane_axis(function: Callable, n_shared: int = 0, name: str = "a function") -> Callable:
    """Return a function of lanes on the last axis from a function of one lane, with a name.

    The first `n_shared` arguments are the same for all lanes.
    """
    with_lanes_for_machine_code = append_lane_axis(function, n_shared)

    def call_with_lanes(*arguments: Any) -> Any:
        if targets_machine_code():
            return with_lanes_for_machine_code(*arguments)
        in_axes = (*[None] * n_shared, *[-1] * (len(arguments) - n_shared))
        return jax.vmap(function, in_axes, -1)(*arguments)

    call_with_lanes.__qualname__ = name  # Warnings name the user's function.
    return call_with_lanes
