"""How a drive is going, on standard error: a bar in a terminal, a line now and then elsewhere."""

from __future__ import annotations

import time

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from sequences.run_result import FrameRow

_SECONDS_BETWEEN_LINES = 10.0


class ConsoleProgress:
    """Shows frames done, frames per second and the running error. Use it as a context manager.

    Parameters
    ----------
    console
        Where to; not a terminal: plain lines.
    label
        What is running.
    """

    def __init__(self, console: Console, label: str) -> None:
        self._console, self._label = console, label
        self._frames = self._done = 0
        self._error_sum = 0.0
        self._begin = self._last_line = time.perf_counter()
        self._bar: Progress | None = None
        self._task: TaskID | None = None

    def __enter__(self) -> ConsoleProgress:
        if self._console.is_terminal:
            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn("{task.fields[status]}"),
                TimeRemainingColumn(),
                console=self._console,
                transient=True,
            )
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def start(self, frames: int) -> None:
        """The drive has so many frames."""
        self._frames, self._begin = frames, time.perf_counter()
        self._last_line = self._begin
        if self._bar is not None:
            self._task = self._bar.add_task(self._label, total=frames, status="")

    def frame(self, row: FrameRow, error_m: float | None) -> None:
        """One more frame is done."""
        self._done += 1
        now = time.perf_counter()
        status = f"{self._done / max(now - self._begin, 1e-9):.1f} frames/s"
        if error_m is not None:
            self._error_sum += error_m
            status += f", error {error_m:.2f} m (mean {self._error_sum / self._done:.2f} m)"
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=self._done, status=status)
        elif now - self._last_line > _SECONDS_BETWEEN_LINES:
            self._last_line = now
            self._console.print(f"{self._label}: {self._done}/{self._frames} frames, {status}", highlight=False)
