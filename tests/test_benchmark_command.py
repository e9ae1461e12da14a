"""Benchmarks as commands: what they refuse is one line, with exit code 2."""

import sys

import pytest

from benchmarks.command import run
from fusion.errors import SkyfixError


def test_a_refusal_is_one_line_and_exit_code_2(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(worlds: int = 1) -> None:
        raise SkyfixError(f"worlds: expected some, got {worlds}")

    monkeypatch.setattr(sys, "argv", ["refuse", "--worlds", "0"])
    with pytest.raises(SystemExit) as caught:
        run(refuse, "refusal")
    assert caught.value.code == 2
    assert capsys.readouterr().err == "refusal: error: worlds: expected some, got 0\n"
