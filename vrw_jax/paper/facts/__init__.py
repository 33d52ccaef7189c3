"""Facts of the paper, published and computed."""

from vrw_jax.paper.facts.table import compute_paper_facts, format_facts_page, write_facts_files
