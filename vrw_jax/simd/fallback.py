"""Fallback to XLA on releases of JAX with which machine code was not tested."""

import warnings

import jax

LATEST_TESTED_JAX = (0, 12)
"""Latest release of JAX (major, minor) with which all tests of machine code pass."""

_failure_reasons: list[str] = []
"""Reasons why this process uses XLA instead of machine code; the list is empty as long as machine
code works.
"""


def is_tested_release() -> bool:
    """Return whether machine code was tested with the installed release of JAX."""
    return jax.__version_info__[:2] <= LATEST_TESTED_JAX


def is_disabled() -> bool:
    """Return whether machine code has failed in this process on an untested release of JAX."""
    return bool(_failure_reasons)


def disable(reason: object) -> None:
    """Use XLA instead of machine code from now on, and issue a warning the first time; `reason` is
    the failure.
    """
    _failure_reasons.append(str(reason))
    if len(_failure_reasons) == 1:
        latest = ".".join(map(str, LATEST_TESTED_JAX))
        warnings.warn(
            f"machine code does not work with JAX {jax.__version__} ({reason}); XLA computes "
            f"instead, which is slower. Machine code is tested up to JAX {latest}.",
            stacklevel=2,
        )
