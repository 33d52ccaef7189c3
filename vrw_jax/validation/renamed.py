"""Public names of version 0.1. The use of such a name raises an error that states the present
name.
"""

import functools
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

RENAMED_PACKAGE_NAMES = {
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
"""Present names in `vrw_jax` by old name."""

RENAMED_NUMERICS_NAMES = {
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
"""Present names of former attributes of `vrw_jax.numerics` by old name."""


def raise_for_missing_numerics_name(missing_name: str) -> Any:
    """Raise the AttributeError for a name that `vrw_jax.numerics` does not have, with the present
    name if it was renamed."""
    renaming_hint = (
        f": it is called {RENAMED_NUMERICS_NAMES[missing_name]} now"
        if missing_name in RENAMED_NUMERICS_NAMES
        else ""
    )
    raise AttributeError(f"vrw_jax.numerics has no {missing_name!r}{renaming_hint}.")


FunctionType = TypeVar("FunctionType", bound=Callable)


def describe_renamed_attribute(
    module_name: str, attribute_name: str, new_name_by_old: Mapping[str, str]
) -> str | None:
    """Return a sentence with the present name of a renamed attribute, or None if it was not
    renamed."""
    if attribute_name not in new_name_by_old:
        return None
    present_name = new_name_by_old[attribute_name]
    return f"{module_name} has no {attribute_name!r}: it is called {present_name} now."


def raise_for_renamed_arguments(
    **new_name_by_old_name: str,
) -> Callable[[FunctionType], FunctionType]:
    """Return a decorator with which old keyword arguments of a function or class raise a TypeError.

    `new_name_by_old_name` maps old names to the present ones. The message states the present name.
    """

    def reject_renamed_keywords(owner_name: str, given_keywords: Mapping[str, Any]) -> None:
        for old_name in new_name_by_old_name.keys() & given_keywords.keys():
            raise TypeError(
                f"{owner_name} has no argument {old_name!r}: it is called "
                f"{new_name_by_old_name[old_name]} now."
            )

    def decorate_with_check(decorated_object: Any) -> Any:
        if isinstance(decorated_object, type):
            original_init = decorated_object.__init__  # type: ignore[misc]

            @functools.wraps(original_init)
            def initialize_checked(self: Any, *args: Any, **keywords: Any) -> None:
                reject_renamed_keywords(decorated_object.__name__, keywords)
                original_init(self, *args, **keywords)

            decorated_object.__init__ = initialize_checked  # type: ignore[misc]
            return decorated_object

        @functools.wraps(decorated_object)
        def call_checked(*args: Any, **keywords: Any) -> Any:
            reject_renamed_keywords(decorated_object.__name__, keywords)
            return decorated_object(*args, **keywords)

        return call_checked

    return decorate_with_check
