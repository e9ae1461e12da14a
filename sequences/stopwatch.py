"""How long the stages of a frame took."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass(slots=True)
class Stopwatch:
    """Milliseconds by stage."""

    milliseconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Time what is inside as a stage."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            taken = 1e3 * (time.perf_counter() - begin)
            self.milliseconds[stage] = self.milliseconds.get(stage, 0.0) + taken
