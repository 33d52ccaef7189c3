"""Registry of models, and the attributes of a dataset that state how a model computed it.

To add a model, only the table in this module has to be extended.
"""

import platform
from typing import Any

import jax
import jax.numpy as jnp

from vrw_jax.base.options import StepOptions, list_tree_parameters
from vrw_jax.lanes.disk_cache import find_library_version
from vrw_jax.models.interface import AbstractWheel
from vrw_jax.models.ladder import LadderWheel
from vrw_jax.models.rigid import RigidWheel
from vrw_jax.models.unilateral_wheel import UnilateralWheel
from vrw_jax.models.viscoelastic import ViscoelasticWheel
from vrw_jax.wheel.params import WheelParams

MODEL_CLASSES: dict[str, type[AbstractWheel]] = {
    "viscoelastic": ViscoelasticWheel,
    "rigid": RigidWheel,
    "unilateral": UnilateralWheel,
    "auto": LadderWheel,
}
"""Classes of all models by their names in a configuration, in the order in which error messages
list them. The first class is the default model.
"""


def list_model_config_names(
    command_name: str | None = None, parameter_name: str | None = None
) -> tuple[str, ...]:
    """Return the configuration names of all models that satisfy two optional conditions.

    - `command_name`: command that must accept the model;
    - `parameter_name`: parameter on which the model's motion must depend.
    """
    return tuple(
        config_name
        for config_name, model_class in MODEL_CLASSES.items()
        if (command_name is None or command_name in model_class.commands)
        and (parameter_name is None or parameter_name in model_class().parameter_names)
    )


def describe_accepted_models(
    command_name: str | None = None, parameter_name: str | None = None
) -> str:
    """Return the models from `list_model_config_names` as expressions that users can write.

    An example is `vrw.RigidWheel() or "auto"`.
    """
    *first_expressions, last_expression = (
        f'"{name}"' if name == "auto" else f"vrw.{MODEL_CLASSES[name].__name__}()"
        for name in list_model_config_names(command_name, parameter_name)
    )
    return " or ".join(filter(None, (", ".join(first_expressions), last_expression)))


def collect_provenance_attributes(
    params: Any, model: object, options: StepOptions | None = None
) -> dict[str, str | float | int]:
    """Return dataset attributes that describe how a result was computed.

    They state versions, device, floating-point type, tolerances and parameters. The default of
    `options` is `StepOptions()`.
    """
    options = StepOptions() if options is None else options
    parameter_attributes: dict[str, str | float | int] = {
        f"parameter_{parameter.name}": float(parameter.value)
        for parameter in list_tree_parameters(params)
        if jnp.ndim(parameter.value) == 0
    }
    if isinstance(params, WheelParams):
        parameter_attributes["parameter_n_legs"] = params.n_legs
    return parameter_attributes | {
        "model": repr(model),
        "versions": ", ".join(
            f"{library_name} {find_library_version(library_name)}"
            for library_name in ("vrw-jax", "jax", "diffrax", "numpy")
        )
        + f", python {platform.python_version()}",
        "device": jax.devices()[0].device_kind,
        "dtype": str(jnp.result_type(*jax.tree.leaves(params), float)),
        "solver": options.solver,
        "rtol": float(options.rtol),
        "atol": float(options.atol),
    }
