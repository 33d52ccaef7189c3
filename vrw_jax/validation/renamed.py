"""Public names of version 0.1: each is refused in one sentence that gives the present name."""

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
"""Names of `vrw_jax`."""

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
"""Names of `vrw_jax.numerics`."""


def refuse_renamed_numerics(name: str) -> Any:
    """Raise the AttributeError of `vrw_jax.numerics` for a name that it does not have."""
    hint = f": it is called {RENAMED_IN_NUMERICS[name]} now" if name in RENAMED_IN_NUMERICS else ""
    raise AttributeError(f"vrw_jax.numerics has no {name!r}{hint}.")


FunctionType = TypeVar("FunctionType", bound=Callable)


def describe_renamed(module: str, name: str, renamed: Mapping[str, str]) -> str | None:
    """Return the sentence about a name that was renamed, or None."""
    if name not in renamed:
        return None
    return f"{module} has no {name!r}: it is called {renamed[name]} now."


def refuse_renamed_arguments(**renamed: str) -> Callable[[FunctionType], FunctionType]:
    """Return a decorator that refuses old keyword arguments of a function or a class.

    `renamed`: old names with the present ones. The decorated function raises a TypeError for an
    old name, in one sentence that gives the present one.
    """

    def check_keywords(owner: str, keywords: Mapping[str, Any]) -> None:
        for old in renamed.keys() & keywords.keys():
            raise TypeError(f"{owner} has no argument {old!r}: it is called {renamed[old]} now.")

    def decorate(function: Any) -> Any:
        if isinstance(function, type):
            initialize = function.__init__  # type: ignore[misc]

            @functools.wraps(initialize)
            def checked_init(self: Any, *args: Any, **keywords: Any) -> None:
                check_keywords(function.__name__, keywords)
                initialize(self, *args, **keywords)

            function.__init__ = checked_init  # type: ignore[misc]
            return function

        @functools.wraps(function)
        def checked_call(*args: Any, **keywords: Any) -> Any:
            check_keywords(function.__name__, keywords)
            return function(*args, **keywords)

        return checked_call

    return decorate
