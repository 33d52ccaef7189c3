"""Fallback to XLA on releases of JAX with which machine code has not been tested."""

import warnings

import jax

LATEST_TESTED_JAX_RELEASE = (0, 12)
"""Latest release of JAX (major, minor) with which all tests of machine code pass."""

_machine_code_failure_reasons: list[str] = []
"""Reasons why this process uses XLA instead of machine code. The list is empty as long as machine
code works.
"""


def is_tested_jax_release() -> bool:
    """Return whether machine code has been tested with the installed release of JAX."""
    return jax.__version_info__[:2] <= LATEST_TESTED_JAX_RELEASE


def is_machine_code_disabled() -> bool:
    """Return whether machine code has failed in this process on an untested release of JAX."""
    return bool(_machine_code_failure_reasons)


def disable_machine_code(failure_reason: object) -> None:
    """Disable machine code in this process, so that XLA computes instead. Issue a warning the first
    time.
    """
    _machine_code_failure_reasons.append(str(failure_reason))
    if len(_machine_code_failure_reasons) == 1:
        latest_tested_release = ".".join(map(str, LATEST_TESTED_JAX_RELEASE))
        warnings.warn(
            f"machine code does not work with JAX {jax.__version__} ({failure_reason}); XLA "
            "computes instead, which is slower. Machine code is tested up to JAX "
            f"{latest_tested_release}.",
            stacklevel=2,
        )
