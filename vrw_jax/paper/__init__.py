"""Comparison of the paper's published results with results that this library computes."""

from vrw_jax.paper.facts.base import PaperFact
from vrw_jax.paper.facts.table import summarize_paper_facts
from vrw_jax.paper.reproduction import reproduce_paper
