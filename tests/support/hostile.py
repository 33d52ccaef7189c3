"""Draw invalid values for every argument of the public functions by hypothesis.

As a program the module draws a number of values for each call, in a process without the annotation
checks of the tests. It prints the calls that neither return nor raise an error of one sentence.
"""

import sys

import numpy as np
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st


def values(hostile):
    """Return a strategy for arguments of any type; whole numbers stay small, because they set the
    work."""
    plain = (
        st.none() | st.booleans() | st.integers(-3, 3) | st.floats() | st.text(max_size=9)
        | st.complex_numbers() | st.binary(max_size=9) | st.dates()
        | st.integers(min_value=2**63) | st.decimals() | st.fractions()
    )  # fmt: skip
    nested = st.recursive(
        plain,
        lambda inner: (
            st.lists(inner, max_size=3)
            | st.tuples(inner, inner)
            | st.dictionaries(st.text(max_size=5), inner, max_size=2)
        ),
        max_leaves=5,
    )
    kinds = st.sampled_from(["f2", "f4", "f8", "i1", "u1", "i8", "?", "c16", "U3", "O", "M8[s]"])
    arrays = st.builds(
        lambda kind, shape: np.zeros(shape, kind), kinds, st.sampled_from([(), (0,), (2,), (3, 3)])
    )
    return st.sampled_from([*hostile.values()]) | nested | arrays


def main(examples):
    """Make the calls, print those that end with a fault, and return their number."""
    from experiments.hardening.random_calls import (
        FAULTS,
        hostile_values,
        make_call,
        valid_calls,
    )

    argument_values, fault_by_call = values(hostile_values()), {}
    for name, call in valid_calls().items():

        @settings(
            max_examples=examples, derandomize=True, database=None, deadline=None,
            phases=[Phase.generate], suppress_health_check=list(HealthCheck),
        )  # fmt: skip
        @given(st.just(name), st.sampled_from([*call.arguments]), argument_values)
        def one(name, argument, value):
            ending = make_call(name, {argument: value})
            if ending.kind in FAULTS:
                fault_by_call[name, argument, ending.error[:120]] = ending.kind

        one()
    for call, kind in fault_by_call.items():
        print(kind, *call)
    return len(fault_by_call)


if __name__ == "__main__":
    import vrw_jax as vrw

    vrw.start_jax(sys.argv[1])
    sys.exit(min(main(int(sys.argv[2])), 1))
