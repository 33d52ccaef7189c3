"""Conversion of results to text and tables."""

from vrw_jax.printing.text import (
    AbstractPrintable,
    LabelAndText,
    format_each_batch_element,
    format_heading_and_rows,
    format_html_table,
    format_markdown_table,
    format_numbers,
    format_outcome_counts,
    format_quantity,
)
