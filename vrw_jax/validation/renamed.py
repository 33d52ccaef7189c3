"""Public names of version 0.1. Each of them raises an error that states the new name."""

import functools
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

NEW_PUBLIC_NAME_BY_OLD_NAME = {
    "Answer": "MeasureResult",
    "Average": "MultifidelityMean",
    "Border": "SpecialPoint",
    "BorderCurve": "SpecialPointCurve",
    "Indicators": "DoubleSupportIndicators",
    "Options": "StepOptions",
    "SectionCycle": "FixedPointResult",
    "Steps": "StepBatchResult",
    "Tuned": "TuneResult",
    "WalkedCycle": "ReturnMapCycle",
    "answer": "measure_to_tolerance",
    "average": "multifidelity_mean",
    "border_curve": "continue_special_point",
    "newton_cycle": "solve_fixed_point",
    "steps": "step_batch",
}
"""New names in `vrw_jax`, by old name."""

NEW_NUMERICS_NAME_BY_OLD_NAME = {
    "AbstractFollowed": "vrw_jax.continuation.AbstractContinuationProblem",
    "Answers": "vrw_jax.hybrid.LCPStatus",
    "Guard": "vrw_jax.hybrid.Guard",
    "MapFollowed": "vrw_jax.continuation.FixedPointProblem",
    "Mode": "vrw_jax.hybrid.Mode",
    "Options": "vrw_jax.StepOptions",
    "SectionCycle": "vrw_jax.FixedPointResult",
    "Stop": "vrw_jax.hybrid.Termination",
    "arclength": "the module arclength of vrw_jax.continuation",
    "complementary": "vrw_jax.hybrid.enumerate_lcp_solutions",
    "multipliers": "vrw_jax.continuation.floquet_multipliers",
    "newton_cycle": "vrw_jax.solve_fixed_point",
    "product_multipliers": "vrw_jax.hybrid.product_multipliers",
    "segment_maps": "vrw_jax.hybrid.segment_maps",
    "time_errors": "vrw_jax.hybrid.time_errors",
    "volume_change": "vrw_jax.hybrid.flow_jacobian_determinant",
    "walk": "vrw_jax.hybrid.simulate_hybrid",
}
"""New names of former attributes of `vrw_jax.numerics`, by old name."""


def raise_missing_numerics_attribute(missing_attribute_name: str) -> Any:
    """Raise an AttributeError for a name that `vrw_jax.numerics` does not have.

    If the name was changed, the error message states the new name.
    """
    renaming_hint = (
        f": it is called {NEW_NUMERICS_NAME_BY_OLD_NAME[missing_attribute_name]} now"
        if missing_attribute_name in NEW_NUMERICS_NAME_BY_OLD_NAME
        else ""
    )
    raise AttributeError(f"vrw_jax.numerics has no {missing_attribute_name!r}{renaming_hint}.")


FunctionType = TypeVar("FunctionType", bound=Callable)


def describe_renamed_attribute(
    module_name: str, attribute_name: str, new_name_by_old_name: Mapping[str, str]
) -> str | None:
    """Return a sentence that states the new name of a renamed attribute.

    Return None if the attribute has not been renamed.
    """
    if attribute_name not in new_name_by_old_name:
        return None
    new_name = new_name_by_old_name[attribute_name]
    return f"{module_name} has no {attribute_name!r}: it is called {new_name} now."


def with_renamed_arguments(
    **new_name_by_old_name: str,
) -> Callable[[FunctionType], FunctionType]:
    """Return a decorator for functions and classes whose keyword arguments have been renamed.

    An old keyword raises a TypeError whose message states the new name. `new_name_by_old_name`
    maps old names to new names.
    """

    def decorate_with_keyword_check(decorated_object: Any) -> Any:
        is_class = isinstance(decorated_object, type)
        original_function = decorated_object.__init__ if is_class else decorated_object

        @functools.wraps(original_function)
        def call_with_new_keywords(*args: Any, **keywords: Any) -> Any:
            for old_name in new_name_by_old_name.keys() & keywords.keys():
                raise TypeError(
                    f"{decorated_object.__name__} has no argument {old_name!r}: it is called "
                    f"{new_name_by_old_name[old_name]} now."
                )
            return original_function(*args, **keywords)

        if not is_class:
            return call_with_new_keywords
        decorated_object.__init__ = call_with_new_keywords
        return decorated_object

    return decorate_with_keyword_check
