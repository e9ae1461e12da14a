"""How a benchmark is run as a command: refusals are one line, and exit code 2."""

from __future__ import annotations

import sys
from collections.abc import Callable

import typer

from fusion.errors import SkyfixError


def run(main: Callable[..., None], name: str) -> None:
    """Run a benchmark's `main` on the command line's arguments."""
    try:
        typer.run(main)
    except SkyfixError as error:
        print(f"{name}: error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
