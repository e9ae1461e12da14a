"""The record of a training run: OUT/loss.csv, and TensorBoard's event files where they are asked for."""

from __future__ import annotations

import csv
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fusion.errors import SkyfixError

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

_COLUMNS = ("step", "loss", "validation_nll", "seconds", "learning_rate")


class TrainingLog:
    """A row of loss.csv for every validation, a point in TensorBoard for every step.

    Rows beyond the step that training goes on from belong to a run that was killed before it could write its state;
    they are dropped.

    Parameters
    ----------
    out_dir
        Gets loss.csv, and tensorboard/ if `tensorboard` is set.
    step
        Where training goes on.

    Raises
    ------
    SkyfixError
        If TensorBoard is asked for and not installed.
    """

    def __init__(self, out_dir: Path, step: int, tensorboard: bool = False) -> None:
        self._path = out_dir / "loss.csv"
        self._rows = [row for row in _read(self._path) if int(row["step"]) <= step]
        self._seconds = float(self._rows[-1]["seconds"]) if self._rows else 0.0
        self._began = time.monotonic()
        self._recent: list[dict[str, float]] = []
        self._board = _board(out_dir / "tensorboard", step) if tensorboard else None

    def step(self, step: int, terms: dict[str, float], learning_rate: float) -> None:
        """A step has been taken: its loss terms by name, "total" among them."""
        self._recent.append(terms)
        if self._board is not None:
            for name, value in terms.items():
                self._board.add_scalar(f"training/{name}", value, step)
            self._board.add_scalar("training/learning_rate", learning_rate, step)

    def validation(self, step: int, nll: float, learning_rate: float) -> None:
        """A validation has been made: write the means over the steps since the one before."""
        means = {name: float(np.mean([terms[name] for terms in self._recent])) for name in self._recent[-1]}
        seconds = self._seconds + time.monotonic() - self._began
        row = [str(step), f"{means.pop('total'):.4f}", f"{nll:.4f}", f"{seconds:.0f}", f"{learning_rate:.3e}"]
        self._rows.append(dict(zip(_COLUMNS, row, strict=True)) | {k: f"{v:.4f}" for k, v in means.items()})
        self._recent = []
        _write(self._path, self._rows)
        if self._board is not None:
            self._board.add_scalar("validation/nll", nll, step)
            self._board.flush()

    def close(self) -> None:
        """Finish TensorBoard's files."""
        if self._board is not None:
            self._board.close()


def _read(path: Path) -> list[dict[str, str]]:
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def _write(path: Path, rows: list[dict[str, str]]) -> None:
    partial = path.with_suffix(".csv.part")
    try:
        with partial.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[-1]), restval="", extrasaction="ignore")
            writer.writeheader()
            writer.writerows(rows)
        partial.replace(path)
    except OSError as error:
        raise SkyfixError(f"training: {path} cannot be written: {error.strerror}") from error


def _board(folder: Path, step: int) -> SummaryWriter:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise SkyfixError("training: expected the package tensorboard for --tensorboard, found none") from error
    return SummaryWriter(str(folder), purge_step=step + 1)
