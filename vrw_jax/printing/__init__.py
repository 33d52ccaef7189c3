"""Texts and tables of results."""

from vrw_jax.printing.text import (
    AbstractPrintable,
    LabelAndText,
    describe_elements,
    describe_ending,
    format_html_table,
    format_markdown_table,
    format_mathtext,
    format_numbers,
    format_outcome_counts,
    format_quantity,
    format_text,
)
