"""The examples run as they stand and say what they claim."""

from __future__ import annotations

import re
import runpy
from collections.abc import Callable
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


def test_online_tracking_stays_near_while_odometry_drifts(capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(EXAMPLES / "online_tracking.py"), run_name="__main__")
    text = capsys.readouterr().out
    assert "emulated" in text
    rows = re.findall(r"([\d.]+) m +([\d.]+) m +([\d.]+) m +([\d.]+)$", text, flags=re.MULTILINE)
    assert len(rows) == 10
    off, sigma, odometry, lost = (float(value) for value in rows[-1])
    assert off < 3.0 * sigma
    assert off < 0.5 * odometry
    assert sigma < 1.5
    assert lost < 0.1
    assert re.search(r"2001 odometry messages, 40 likelihoods, 40 of them late and replayed", text)


def test_a_gtsam_graph_of_ones_own_takes_whole_likelihoods(capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(EXAMPLES / "gtsam_graph.py"), run_name="__main__")
    found = re.search(r"odometry ([\d.]+) m, map ([\d.]+) m", capsys.readouterr().out)
    assert found is not None
    odometry, on_map = (float(value) for value in found.groups())
    assert on_map < 0.5
    assert on_map < 0.3 * odometry


def test_kiss_icp_is_held_to_the_map(
    shared_data: Callable[[str], Path], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("kiss_icp")
    monkeypatch.setattr("sys.argv", ["kiss_icp_tracking.py", str(shared_data("kitti_raw_0013_start"))])
    runpy.run_path(str(EXAMPLES / "kiss_icp_tracking.py"), run_name="__main__")
    said = r"10 of 40 scans measured: tracker ends ([\d.]+) m off, KISS-ICP alone ([\d.]+) m"
    found = re.search(said, capsys.readouterr().out)
    assert found is not None
    tracker, alone = (float(value) for value in found.groups())
    assert tracker < 1.0
    assert alone > 5.0
