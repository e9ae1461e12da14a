"""The loss of a training run against its steps."""

from __future__ import annotations

import csv
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure


def draw_loss_curve(loss_csv: Path, png: Path, title: str) -> None:
    """Plot training loss and validation NLL (nats, per m^2 rad) of loss.csv, as `learned.training.train` writes it."""
    with loss_csv.open(newline="") as file:
        rows = list(csv.DictReader(file))
    steps = [int(row["step"]) for row in rows]
    figure = Figure(figsize=(7, 4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.plot(steps, [float(row["loss"]) for row in rows], label="training loss (augmented)")
    axes.plot(steps, [float(row["validation_nll"]) for row in rows], label="validation NLL")
    axes.set(xlabel="step", ylabel="loss; NLL of the true pose, nats per m\u00b2 rad", title=title)
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(png, dpi=120)
