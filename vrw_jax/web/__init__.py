"""The wheel in a browser: the page that computes by itself, and the same as a widget."""

from vrw_jax.web.explorer import explore, page_address
