"""Published facts of the paper, and the computed value for each fact."""

from vrw_jax.paper.facts.table import compute_paper_facts, format_facts_page, write_facts_files
