"""Public names of version 0.1; the use of one raises an error that gives the present name."""

import functools
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

RENAMED_IN_PACKAGE = {
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
"""Old names of `vrw_jax`, each with the present one."""

RENAMED_IN_NUMERICS = {
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
"""Old names of `vrw_jax.numerics`, each with the present one."""


def raise_for_renamed_numerics(name: str) -> Any:
    """Raise the AttributeError of `vrw_jax.numerics` for a name that it does not have."""
    hint = f": it is called {RENAMED_IN_NUMERICS[name]} now" if name in RENAMED_IN_NUMERICS else ""
    raise AttributeError(f"vrw_jax.numerics has no {name!r}{hint}.")


FunctionType = TypeVar("FunctionType", bound=Callable)


def describe_renamed(module: str, name: str, new_name_by_old: Mapping[str, str]) -> str | None:
    """Return a sentence with the present name of a renamed attribute, or None."""
    if name not in new_name_by_old:
        return None
    return f"{module} has no {name!r}: it is called {new_name_by_old[name]} now."


def raise_for_renamed_arguments(**renamed: str) -> Callable[[FunctionType], FunctionType]:
    """Return a decorator that makes old keyword arguments of a function or class raise a TypeError.

    `renamed` maps old names to the present ones. The message gives the present name.
    """

    def check_keywords(owner_name: str, keywords: Mapping[str, Any]) -> None:
        for old_name in renamed.keys() & keywords.keys():
            raise TypeError(
                f"{owner_name} has no argument {old_name!r}: it is called {renamed[old_name]} now."
            )

    def decorate(function: Any) -> Any:
        if isinstance(function, type):
            original_init = function.__init__  # type: ignore[misc]

            @functools.wraps(original_init)
            def checked_init(self: Any, *args: Any, **keywords: Any) -> None:
                check_keywords(function.__name__, keywords)
                original_init(self, *args, **keywords)

            function.__init__ = checked_init  # type: ignore[misc]
            return function

        @functools.wraps(function)
        def checked_call(*args: Any, **keywords: Any) -> Any:
            check_keywords(function.__name__, keywords)
            return function(*args, **keywords)

        return checked_call

    return decorate
