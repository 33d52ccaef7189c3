"""The paper's facts, published against found."""

from vrw_jax.paper.facts.table import all_facts, as_page, write
