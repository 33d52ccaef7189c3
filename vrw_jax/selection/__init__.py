"""Selection of the simplest model whose assumptions hold for a step."""

from vrw_jax.selection.ladder import (
    SELECTION_VARIABLE_ATTRIBUTES,
    LadderStep,
    LadderWheel,
    ModelChoice,
    ModelCode,
    find_selection_reason,
)
from vrw_jax.selection.registry import (
    REGISTERED_MODEL_CLASSES,
    describe_accepted_models,
    find_model_class,
    list_model_config_names,
)
