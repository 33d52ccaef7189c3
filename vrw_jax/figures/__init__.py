"""Pictures of labelled results; the only room that knows matplotlib."""

from vrw_jax.figures import walk
from vrw_jax.figures.branch import border_text, branch_figure
from vrw_jax.figures.scan import scan_figures
from vrw_jax.figures.tuning import tuning
