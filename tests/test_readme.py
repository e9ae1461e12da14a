"""What the README and the pages of docs show works: the Python runs as it stands, commands and files exist."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = {page: page.read_text(encoding="utf-8") for page in (ROOT / "README.md", *sorted(ROOT.glob("docs/*.md")))}


def blocks(language: str) -> list[str]:
    """The README's fenced blocks in one language, in order."""
    return blocks_of(README, language)


def blocks_of(page: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", page, flags=re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def namespace(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Names that the Python blocks leave behind, run in order, one after the other."""
    names: dict[str, Any] = {"__name__": "readme"}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("readme"))
        for block in blocks("python"):
            exec(compile(block, "README.md", "exec"), names)
    return names


def test_python_tracks_without_drift(namespace: dict[str, Any]) -> None:
    truth = namespace["truth"]
    errors = {
        name: np.linalg.norm(namespace[name].poses[:, :2] - truth[:, :2], axis=1) for name in ("filtered", "smoothed")
    }
    # The stand-in network is off by 1.25 m on average, the odometry drifts by 3 % of 400 m and more.
    assert errors["filtered"][-50:].mean() < 1.0
    assert errors["smoothed"].mean() < errors["filtered"].mean()
    assert namespace["estimates"][-1].lost_score < 0.1


def test_a_network_that_knows_nothing_is_uniform(namespace: dict[str, Any]) -> None:
    likelihood = namespace["knows_nothing"]
    expected = -np.log(likelihood.grid.area_m2 * 2 * np.pi)
    np.testing.assert_allclose(likelihood.log_density(namespace["truth"][:3]), expected, rtol=1e-4)


def named_commands() -> dict[str, set[str]]:
    """Subcommands that the pages (shell blocks, inline) and the Makefile name, with the options shown for each."""
    makefile = re.findall(r"\$\(BIN\)/(skyfix .*)", (ROOT / "Makefile").read_text(encoding="utf-8"))
    texts = list(makefile)
    for page in PAGES.values():
        texts += [block.replace("\\\n", " ") for block in blocks_of(page, "sh")]
        texts += [inline.replace("\n", " ") for inline in re.findall(r"(?<!`)`([^`]+)`(?!`)", page)]
    found: dict[str, set[str]] = {}
    for command, rest in re.findall(r"\bskyfix ([a-z-]+)([^#\n]*)", "\n".join(texts)):
        found.setdefault(command, set()).update(re.findall(r"--[a-z-]+", rest))
    return found


def test_readme_names_commands() -> None:
    assert {"demo", "track", "evaluate", "view"} <= set(named_commands())
    assert len(named_commands()["track"]) >= 3


@pytest.mark.parametrize(("command", "options"), sorted(named_commands().items()))
def test_commands_and_their_options_exist(command: str, options: set[str]) -> None:
    run = subprocess.run(
        [sys.executable, "-m", "sequences.cli", command, "--help"],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
        env={**os.environ, "COLUMNS": "200", "NO_COLOR": "1", "TERM": "dumb"},
    )
    assert run.returncode == 0, run.stderr
    assert f"{command} [OPTIONS]" in run.stdout
    assert options <= set(re.findall(r"--[a-z-]+", run.stdout))


def test_make_targets_exist() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in re.findall(r"\bmake ([a-z]+)", "\n".join([*blocks("sh"), *re.findall(r"`([^`\n]+)`", README)])):
        assert re.search(rf"^{target}:", makefile, flags=re.MULTILINE), target


def test_pictures_and_files_exist() -> None:
    for page, text in PAGES.items():
        for name in re.findall(r"\]\((?!https?://|#)([^)]+)\)", text):
            assert (page.parent / name).is_file(), f"{page.name}: {name}"
    for name in ("LICENSE", "CHANGELOG.md", "constraints.txt"):
        assert (ROOT / name).is_file(), name
