"""Facts of the paper, published and computed."""

from vrw_jax.paper.facts.table import all_facts, as_page, write
