"""The paper's facts, published against found."""

from vrw_jax.paper.facts.base import Evidence, Fact
from vrw_jax.paper.facts.table import as_markdown, facts, write
