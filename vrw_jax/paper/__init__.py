"""What the paper publishes, set beside what is computed here."""

from vrw_jax.paper.facts.base import Fact
from vrw_jax.paper.facts.table import held
from vrw_jax.paper.reproduction import reproduce
