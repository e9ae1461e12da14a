"""The same thing done with several seeds: numbers as mean and standard deviation, tables of them, and their files."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fusion.errors import SkyfixError

Spread = Mapping[str, float | None]
"""`mean` and `std` of a number."""


def mean_and_std(values: Sequence[float]) -> dict[str, float | None]:
    """Mean, and standard deviation of the sample (n - 1), which a single value has none of."""
    spread = float(np.std(values, ddof=1)) if len(values) > 1 else None
    return {"mean": round(float(np.mean(values)), 6), "std": None if spread is None else round(spread, 6)}


def over_seeds(summaries: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, float | None]]:
    """`mean_and_std` of every number of alike summaries, by its dotted key."""
    flat = [numbers(each) for each in summaries]
    return {key: mean_and_std([each[key] for each in flat]) for key in flat[0]}


def numbers(content: Mapping[str, Any], prefix: str = "") -> dict[str, float]:
    """Every number of a summary by its dotted key."""
    flat: dict[str, float] = {}
    for key, value in content.items():
        if isinstance(value, Mapping):
            flat |= numbers(value, f"{prefix}{key}.")
        elif isinstance(value, (int, float)):
            flat[f"{prefix}{key}"] = value
    return flat


def cell(value: Spread | None, unit: float, digits: int | None = None) -> str:
    """`mean ± std` in a unit; shares without decimals; a dash where there is no number."""
    if value is None or value["mean"] is None:
        return "-"
    digits = digits if digits is not None else (0 if unit == 100 else 2)
    text = f"{unit * value['mean']:.{digits}f}"
    return text if value["std"] is None else f"{text} ± {unit * value['std']:.{digits}f}"


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]], left: int) -> str:
    """Rows of cells as Markdown, the first `left` columns aligned to the left."""
    rule = "|" + "---|" * left + "---:|" * (len(header) - left)
    return "\n".join(["| " + " | ".join(header) + " |", rule, *("| " + " | ".join(row) + " |" for row in rows)]) + "\n"


def write_content(out_dir: Path, name: str, content: Mapping[str, Any], text: str) -> None:
    """Write NAME.json and NAME.md, each whole or not at all; SkyfixError if that fails."""
    for suffix, written in ((".json", json.dumps(content, indent=1, allow_nan=False) + "\n"), (".md", text)):
        partial = out_dir / f"{name}{suffix}.part"
        try:
            partial.write_text(written, encoding="utf-8")
            partial.replace(out_dir / f"{name}{suffix}")
        except OSError as error:
            raise SkyfixError(f"{out_dir / name}{suffix}: cannot be written: {error.strerror}") from error
