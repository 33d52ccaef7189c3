"""Checks of arguments, whose messages state what was given, what is allowed and what to do."""

from vrw_jax.validation.checks import (
    check_bool,
    check_callable,
    check_choice,
    check_int,
    check_known_name,
    check_names,
    check_not_traced,
    check_numpy_reals,
    check_path,
    check_positive,
    check_range,
    check_real,
    check_reals,
    check_type,
    format_value,
    is_traced,
    suggest_name,
)
from vrw_jax.validation.renamed import (
    RENAMED_PACKAGE_NAMES,
    describe_renamed_attribute,
    raise_for_missing_numerics_name,
    raise_for_renamed_arguments,
)
