"""The registry of models: a new model is added to this list and nowhere else."""

from vrw_jax.contact import UnilateralWheel
from vrw_jax.models import AbstractWheel, RigidWheel, ViscoelasticWheel
from vrw_jax.selection.ladder import LadderWheel

MODEL_CLASSES: list[type[AbstractWheel]] = [
    ViscoelasticWheel,
    RigidWheel,
    UnilateralWheel,
    LadderWheel,
]
"""Classes of all models, in the order in which messages list them; the first is the default."""


def find_model_class(config_name: str) -> type[AbstractWheel]:
    """Return the class of the model with this name in a configuration.

    Raises: KeyError: no model has this name.
    """
    return {entry.capabilities.config_name: entry for entry in MODEL_CLASSES}[config_name]


def list_config_names(command: str | None = None, parameter: str | None = None) -> tuple[str, ...]:
    """Return the names that models have in a configuration.

    Args:
        command: list only the models that this command accepts.
        parameter: list only the models whose motion depends on this parameter.
    """
    return tuple(
        entry.capabilities.config_name
        for entry in MODEL_CLASSES
        if (command is None or command in entry.capabilities.commands)
        and (parameter is None or parameter in entry.parameter_names)
    )


def describe_models(command: str | None = None, parameter: str | None = None) -> str:
    """Return the same models as a caller writes them: "vrw.RigidWheel() or "auto"", say."""
    expressions = [
        f'"{name}"' if name == "auto" else f"vrw.{find_model_class(name).__name__}()"
        for name in list_config_names(command, parameter)
    ]
    return " or ".join([", ".join(expressions[:-1]), expressions[-1]][not expressions[1:] :])
