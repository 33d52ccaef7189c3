"""Registry of models. To add a model, only the list in this module has to be extended."""

from vrw_jax.models.interface import AbstractWheel
from vrw_jax.models.ladder import LadderWheel
from vrw_jax.models.rigid import RigidWheel
from vrw_jax.models.unilateral_wheel import UnilateralWheel
from vrw_jax.models.viscoelastic import ViscoelasticWheel

REGISTERED_MODEL_CLASSES: list[type[AbstractWheel]] = [
    ViscoelasticWheel,
    RigidWheel,
    UnilateralWheel,
    LadderWheel,
]
"""Classes of all models, in the order in which error messages list them. The first class is the
default model.
"""


def find_model_class(config_name: str) -> type[AbstractWheel]:
    """Return the class of the model whose name in a configuration is `config_name`.

    Raise a `KeyError` if no model has this name.
    """
    return {
        model_class.capabilities.config_name: model_class
        for model_class in REGISTERED_MODEL_CLASSES
    }[config_name]


def list_model_config_names(
    command_name: str | None = None, parameter_name: str | None = None
) -> tuple[str, ...]:
    """Return the configuration names of all models that satisfy two optional conditions.

    - `command_name`: command that must accept the model;
    - `parameter_name`: parameter on which the model's motion must depend.
    """
    return tuple(
        model_class.capabilities.config_name
        for model_class in REGISTERED_MODEL_CLASSES
        if (command_name is None or command_name in model_class.capabilities.accepted_cli_commands)
        and (parameter_name is None or parameter_name in model_class().parameter_names)
    )


def describe_accepted_models(
    command_name: str | None = None, parameter_name: str | None = None
) -> str:
    """Return the models from `list_model_config_names` as expressions that users can write.

    An example is `vrw.RigidWheel() or "auto"`.
    """
    model_expressions = [
        f'"{config_name}"'
        if config_name == "auto"
        else f"vrw.{find_model_class(config_name).__name__}()"
        for config_name in list_model_config_names(command_name, parameter_name)
    ]
    *first_expressions, last_expression = model_expressions
    if not first_expressions:
        return last_expression
    return f"{', '.join(first_expressions)} or {last_expression}"
