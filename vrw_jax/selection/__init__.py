"""Choice of the simplest model that is accurate for a step."""

from vrw_jax.selection.ladder import (
    SELECTION_ATTRS,
    SELECTION_MARGINS,
    UNILATERAL_MODEL,
    VISCOELASTIC_MODEL,
    LadderStep,
    LadderWheel,
    ModelChoice,
    find_selection_reason,
    refuse_ladder,
)
from vrw_jax.selection.registry import (
    MODEL_CLASSES,
    describe_models,
    find_model_class,
    list_config_names,
)
