"""Comparison of the published results of the paper with the results of this library."""

from vrw_jax.paper.facts.base import PaperFact
from vrw_jax.paper.facts.table import summarize_paper_facts
from vrw_jax.paper.reproduction import reproduce_paper
