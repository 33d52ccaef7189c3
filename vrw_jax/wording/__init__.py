"""Validation of arguments, with one sentence per error, and printing of results."""

from vrw_jax.wording.checks import (
    chosen,
    flag,
    function_of,
    instance,
    known_reals,
    names_of,
    nearest,
    positive,
    range_of,
    real,
    reals,
    require_known,
    shown,
    traced,
    untraced,
    whole,
)
from vrw_jax.wording.text import (
    AbstractTold,
    Row,
    as_html,
    as_markdown,
    as_tex,
    as_text,
    counted,
    listed,
    told,
)
