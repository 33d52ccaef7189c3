"""Selection of the simplest model that is accurate for a step."""

from vrw_jax.selection.ladder import (
    SELECTION_ATTRS,
    SELECTION_MARGINS,
    LadderStep,
    LadderWheel,
    ModelChoice,
    ModelCode,
    find_selection_reason,
    refuse_ladder,
)
from vrw_jax.selection.registry import (
    MODEL_CLASSES,
    describe_models,
    find_model_class,
    list_config_names,
)
