"""Command lines of the experiments, and the error if a package is missing."""

import argparse
import importlib
import sys
from pathlib import Path
from types import ModuleType

import vrw_jax as vrw

INSTALL_COMMAND = 'pip install -e ".[experiments]"'
"""Command that installs the packages of the experiments."""


def make_parser(doc: str | None) -> argparse.ArgumentParser:
    """Return a parser whose help shows the docstring of the script."""
    spec = sys.modules["__main__"].__spec__
    return argparse.ArgumentParser(
        f"python -m {spec.name}" if spec else None,
        description=doc,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def parse_and_start_jax(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """Return the parsed arguments, after starting JAX as users of the library do."""
    arguments = parser.parse_args()
    vrw.start_jax()
    return arguments


def parse_folder_and_start_jax(doc: str | None) -> Path:
    """Return the folder for the results, `results` by default, after starting JAX."""
    parser = make_parser(doc)
    parser.add_argument("folder", type=Path, nargs="?", default="results")
    return parse_and_start_jax(parser).folder


def require_extra(name: str, install: str = INSTALL_COMMAND) -> ModuleType:
    """Import and return an optional package; if it is missing, exit with one sentence that names
    the remedy."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as missing:
        raise SystemExit(f"This experiment needs {missing.name}: {install}") from None
