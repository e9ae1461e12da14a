"""Plots of a benchmark: cost of a filter step against the number of particles, and against the size of the map."""

from __future__ import annotations

import re
from pathlib import Path

from matplotlib.figure import Figure

from benchmarks.runner import Row

_MAP = re.compile(r"step, spread, map of (\d+) x")


def write_plots(rows: list[Row], json_file: Path) -> list[Path]:
    """Write PNGs beside the JSON file that the rows went to: NAME-particles.png, NAME-map.png.

    Parameters
    ----------
    rows
        What `run_benchmarks` gave.
    json_file
        Where they were written; only its name is used.
    """
    written = []
    steps = [row for row in rows if row["case"] in ("step, tracking", "step, spread")]
    if steps:
        figure = Figure(figsize=(11.0, 4.5), layout="constrained")
        for axes, case in zip(figure.subplots(1, 2, sharey=True), ("step, tracking", "step, spread"), strict=True):
            for name in dict.fromkeys(row["implementation"] for row in steps):
                curve = [row for row in steps if row["case"] == case and row["implementation"] == name]
                sizes = [row["size"] for row in curve]
                axes.loglog(sizes, [1e9 * row["seconds_min"] / row["size"] for row in curve], ".-", label=name)
            axes.set(title=case, xlabel="particles", ylabel="ns a particle and step")
            axes.grid(alpha=0.3)
        axes.legend(fontsize=7)
        written.append(_save(figure, json_file, "particles"))
    wide = [(int(found[1]), row) for row in rows if (found := _MAP.match(row["case"]))]
    if wide:
        figure = Figure(figsize=(5.5, 4.5), layout="constrained")
        axes = figure.subplots()
        for name in dict.fromkeys(row["implementation"] for _, row in wide):
            measured = [(side, row) for side, row in wide if row["implementation"] == name]
            ns = [1e9 * row["seconds_min"] / row["size"] for _, row in measured]
            axes.semilogx([side for side, _ in measured], ns, ".-", base=2, label=name)
        axes.set(xlabel="side of the map, pixels", ylabel="ns a particle and step", ylim=(0.0, None))
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
        written.append(_save(figure, json_file, "map"))
    return written


def _save(figure: Figure, json_file: Path, what: str) -> Path:
    path = json_file.with_name(f"{json_file.stem}-{what}.png")
    figure.savefig(path, dpi=120)
    return path
