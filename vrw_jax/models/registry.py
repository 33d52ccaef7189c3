"""Registry of models. To add a model, only the table in this module has to be extended."""

from vrw_jax.models.interface import AbstractWheel
from vrw_jax.models.ladder import LadderWheel
from vrw_jax.models.rigid import RigidWheel
from vrw_jax.models.unilateral_wheel import UnilateralWheel
from vrw_jax.models.viscoelastic import ViscoelasticWheel

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
