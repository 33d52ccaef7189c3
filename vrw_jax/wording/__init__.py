"""Validation of arguments, with one sentence per error, and printing of results."""

from vrw_jax.wording.checks import (
    check_bool,
    check_callable,
    check_choice,
    check_int,
    check_known_name,
    check_names,
    check_not_traced,
    check_numpy_reals,
    check_positive,
    check_range,
    check_real,
    check_reals,
    check_type,
    format_value,
    is_traced,
    suggest_name,
)
from vrw_jax.wording.text import (
    AbstractPrintable,
    TextRow,
    format_html_table,
    format_markdown_table,
    format_mathtext,
    format_numbers,
    format_outcome_counts,
    format_quantity,
    format_text,
)
