"""Section maps of hybrid systems along a parameter of the user's."""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
from jaxtyping import Array

from vrw_jax.base.checks import check_int, require_known_name
from vrw_jax.base.options import StepOptions
from vrw_jax.flow.hybrid_system import HybridSystem


def make_section_map(
    system: HybridSystem, name: str, period_n: int, options: StepOptions | None
) -> Callable[[Any, Array, Array], Array]:
    """Return the map of parameters, section coordinates and the value of the parameter `name`."""
    check_int("period_n", period_n)

    def map_section_state(params: Any, x: Array, value: Array) -> Array:
        take_step = system.return_map(replace_parameter(params, name, value), options)
        for _ in range(period_n):
            x = take_step(x)
        return x

    return map_section_state


def find_parameter(params: Any, name: str) -> Any:
    """Return the entry of a tree of parameters with a name such as `stiffness` or `leg.damping`."""
    first, _, rest = name.partition(".")
    if isinstance(params, Mapping):
        require_known_name(first, tuple(params), "parameter")
        entry = params[first]
    else:
        require_known_name(first, tuple(getattr(params, "__annotations__", {})), "parameter")
        entry = getattr(params, first)
    return find_parameter(entry, rest) if rest else entry


def replace_parameter(params: Any, name: str, value: Any) -> Any:
    """Return the tree of parameters with another value of the entry with a name."""
    return eqx.tree_at(lambda tree: find_parameter(tree, name), params, value)
