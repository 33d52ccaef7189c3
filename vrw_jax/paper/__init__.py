"""Comparison of the published results of the paper with the results of this library."""

from vrw_jax.paper.facts.base import Fact
from vrw_jax.paper.facts.table import summarize_facts
from vrw_jax.paper.reproduction import reproduce
