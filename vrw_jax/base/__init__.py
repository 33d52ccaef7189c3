"""Types, checks, printing, options, and algebra of batches."""

from vrw_jax.base.elementwise import compute_arcsine, compute_sine_cosine
from vrw_jax.base.options import StepOptions
from vrw_jax.base.results import (
    format_heading_and_rows,
    format_html_table,
    format_markdown_table,
    format_mathtext,
)
