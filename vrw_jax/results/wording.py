"""Sentences for people: what was meant by a misspelt name, and what may be given."""

import difflib
from collections.abc import Iterable, Sequence


def nearest(name: str, allowed: Iterable[str]) -> str:
    """' (did you mean ...?)' where a name like it is allowed, else nothing."""
    close = difflib.get_close_matches(str(name), list(allowed), n=1, cutoff=0.5)
    return f" (did you mean '{close[0]}'?)" if close else ""


def require_known(name: str, allowed: Sequence[str], what: str) -> None:
    """Refuse a name that is none of those `allowed`: "'dampng' is no parameter ..."."""
    if name not in allowed:
        choice = ", ".join(allowed)
        raise ValueError(f"{name!r} is no {what}{nearest(name, allowed)}: choose from {choice}.")
