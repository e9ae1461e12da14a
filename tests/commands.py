"""`skyfix` as it is called, with what it prints and how it ends."""

from __future__ import annotations

import sys
from dataclasses import dataclass

import pytest

from sequences.cli import main


@dataclass(frozen=True)
class Finished:
    """A command that came to its end."""

    code: int | str | None
    out: str
    err: str


def skyfix(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *arguments: str) -> Finished:
    monkeypatch.setattr(sys, "argv", ["skyfix", *arguments])
    with pytest.raises(SystemExit) as caught:
        main()
    printed = capsys.readouterr()
    return Finished(caught.value.code, printed.out, printed.err)
