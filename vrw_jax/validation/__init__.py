"""Checks of arguments. Error messages state the given value, the allowed values and the remedy."""

from vrw_jax.validation.checks import (
    check_bool,
    check_callable,
    check_choice,
    check_int,
    check_names,
    check_numpy_reals,
    check_path,
    check_positive,
    check_range,
    check_real,
    check_reals,
    check_type,
    format_name_suggestion,
    format_value,
    has_traced_leaf,
    require_known_name,
    require_no_masked_entries,
    require_untraced_arguments,
)
