"""Every example that `--help` prints is a command with options that there are, and names configurations that exist."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
import typer
import typer.core
import typer.main

import sequences
from benchmarks import run_benchmarks
from fusion.errors import SkyfixError
from sequences.ablation_config import read_ablation
from sequences.cli import app
from sequences.train_config import read_config

ROOT = Path(sequences.__file__).parents[1]
GROUP = typer.main.get_command(app)
assert isinstance(GROUP, typer.core.TyperGroup)
COMMANDS = GROUP.commands
EXAMPLES = [
    (name, example) for name, command in COMMANDS.items() for example in re.findall(r"`([^`]+)`", command.epilog or "")
]


def parsed(name: str, example: str) -> dict[str, object]:
    """The parameters that an example gives a command; nothing is run."""
    words = shlex.split(example)
    start = words.index("sequences.cli") + 1 if words[0] == "torchrun" else 1
    assert words[start - 1] in ("skyfix", "sequences.cli")
    assert words[start] == name
    return COMMANDS[name].make_context(name, words[start + 1 :]).params


def test_every_command_has_an_example() -> None:
    assert {name for name, _ in EXAMPLES} == set(COMMANDS)


@pytest.mark.parametrize(("name", "example"), EXAMPLES)
def test_examples_parse_and_name_configurations_that_there_are(name: str, example: str) -> None:
    given = parsed(name, example)
    for word in shlex.split(example):
        if word.endswith((".yaml", ".yml")):
            assert (ROOT / word).is_file(), word
    if name == "train":
        config = read_config(ROOT / str(given["config"]), list(given["override"] or []))
        assert len(config.averaged_shares) == len(list(given["average"] or [])), "it needs --average"
        assert given["data"] != Path(), "no extract lies in the working directory"
    if name == "ablate":
        assert read_ablation(ROOT / str(given["config"]), list(given["override"] or [])).variants
        assert given["data"] != Path()


def test_an_example_that_is_wrong_is_noticed() -> None:
    with pytest.raises(Exception, match="No such option: --date"):
        parsed("train", "skyfix train learned/configs/hybrid.yaml --date osm")
    with pytest.raises(typer.BadParameter):
        parsed("track", "skyfix track")
    with pytest.raises(SkyfixError, match="got no such file"):
        read_config(ROOT / "rotmatch.yaml")


def test_the_benchmark_of_the_example_is_one() -> None:
    """Named before anything is timed: another name is refused."""
    ((_, example),) = [each for each in EXAMPLES if each[0] == "benchmark"]
    with pytest.raises(SkyfixError) as caught:
        run_benchmarks("nothing", 1)
    assert str(parsed("benchmark", example)["name"]) in str(caught.value)


def test_options_that_help_speaks_of_are_options() -> None:
    options = {option for command in COMMANDS.values() for each in command.params for option in each.opts}
    options |= {"--nproc-per-node"}  # torchrun's
    for name, command in COMMANDS.items():
        texts = [
            command.help or "",
            command.epilog or "",
            *(getattr(each, "help", "") or "" for each in command.params),
        ]
        for text in texts:
            for option in re.findall(r"(?<![\w-])--[a-z][a-z0-9-]*", text):
                assert option in options, f"{name}: {option}"
