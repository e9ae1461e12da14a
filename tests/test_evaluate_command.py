"""`skyfix evaluate`: the prior beside every matcher, several starts, back-ends, refusals."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from commands import skyfix
from made_drive import EmulatedMatcher, MadeDrive

import learned.matcher


def test_evaluate_prints_the_prior_beside_every_matcher(
    made_drive: MadeDrive, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    matchers = {
        "sharp": EmulatedMatcher(made_drive.truth.poses, sigma_m=0.3),
        "blunt": EmulatedMatcher(made_drive.truth.poses, sigma_m=3.0),
    }
    monkeypatch.setattr(learned.matcher, "load_matcher", lambda name, backend: matchers[name])
    made_drive.scan_file(0).write_bytes(b"")  # skipped, not fatal: every scan stands for itself
    arguments = ("evaluate", str(made_drive.path), "--matcher", "sharp", "--matcher", "blunt")
    done = skyfix(capsys, monkeypatch, *arguments, "--json", str(tmp_path / "shots.json"), "--max-frames", "15")
    assert done.code == 0
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in done.out.splitlines()]
    assert [row[2] for row in rows[2:]] == ["prior", "sharp", "blunt"]
    assert {len(row) for row in rows} == {len(rows[0])}
    (evaluation,) = json.loads((tmp_path / "shots.json").read_text())
    assert evaluation["skipped_frames"] == 1
    mean = {name: summary["position_error_m"]["mean"] for name, summary in evaluation["methods"].items()}
    assert mean["sharp"] < 0.6 < mean["blunt"] < mean["prior"]
    assert evaluation["methods"]["prior"]["frames"] == 14
    assert done.out == skyfix(capsys, monkeypatch, *arguments, "--max-frames", "15").out


def test_evaluate_takes_several_starts_in_one_call(
    made_drive: MadeDrive, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learned.matcher, "load_matcher", lambda *_: EmulatedMatcher(made_drive.truth.poses))
    few = ("evaluate", str(made_drive.path), "--matcher", "one", "--max-frames", "3")
    table = tmp_path / "table.md"
    both = skyfix(
        capsys, monkeypatch, *few, "--half-heading-deg", "10", "--half-heading-deg", "180", "--markdown", str(table)
    )
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in both.out.splitlines()]
    assert [row[1] for row in rows[2:]] == ["±20 m, ±10°"] * 2 + ["±20 m, any heading"] * 2
    assert both.out in table.read_text()
    unknown = skyfix(capsys, monkeypatch, *few, "--heading-unknown")
    assert unknown.out.splitlines()[2:] == both.out.splitlines()[4:]
    for option, value, message in (
        ("--half-heading-deg", "200", "half heading: expected above 0 and at most 180 degrees, got 200"),
        ("--half-extent", "0", "half extent: expected above 0 m, got 0"),
        ("--max-frames", "0", "max frames: expected 1 or more, got 0"),
    ):
        refused = skyfix(capsys, monkeypatch, *few, option, value)
        assert refused.code == 2
        assert refused.err == f"skyfix: error: {message}\n"


def test_evaluate_hands_the_backend_on_and_names_it(
    made_drive: MadeDrive, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, str | None]] = []
    load = learned.matcher.load_matcher

    def seen(name: str, backend: str | None) -> EmulatedMatcher:
        asked.append((name, backend))
        return EmulatedMatcher(made_drive.truth.poses)

    monkeypatch.setattr(learned.matcher, "load_matcher", seen)
    few = ("evaluate", str(made_drive.path), "--max-frames", "2")
    table = tmp_path / "table.md"
    done = skyfix(capsys, monkeypatch, *few, "--backend", "openvino-int8", "--matcher", "out", "--markdown", str(table))
    assert done.code == 0
    assert [line.split("|")[3].strip() for line in done.out.splitlines()[2:]] == ["prior", "out (openvino-int8)"]
    assert "- out (openvino-int8): `out`" in table.read_text()
    assert skyfix(capsys, monkeypatch, *few, "--backend", "torch").code == 0
    assert skyfix(capsys, monkeypatch, *few).code == 0
    wanted = [("out", "openvino-int8"), ("rotmatch", "torch"), ("rotmatch", None), ("geometric", None)]
    assert asked == wanted
    monkeypatch.setattr(learned.matcher, "load_matcher", load)
    for arguments, message in (
        (("--backend", "tea"), "backend: expected torch or one of openvino, "),
        (("--backend", "onnxruntime", "--matcher", "geometric"), "backend onnxruntime: expected rotmatch or a "),
        (("--backend", "onnxruntime-int8"), "backend onnxruntime-int8: expected a folder of `skyfix export --int8`"),
    ):
        refused = skyfix(capsys, monkeypatch, *few, *arguments)
        assert refused.code == 2
        assert refused.err.startswith(f"skyfix: error: {message}")
        assert refused.err.count("\n") == 1
