"""The wheel in a browser: a page that computes steps, and a notebook widget that shows the page."""

from vrw_jax.web import explorer
from vrw_jax.web.explorer import explore, make_page_address
