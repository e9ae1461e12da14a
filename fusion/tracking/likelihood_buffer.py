"""The recent measurements, by stamp: those that a replay needs, and those that wait for odometry to cover them."""

from bisect import bisect_left, bisect_right, insort
from typing import Any, Self

from fusion.likelihood import PoseLikelihood
from fusion.tracking.archive import Tree
from fusion.tracking.likelihood_tree import likelihood_from_tree, likelihood_tree


class LikelihoodBuffer:
    """Likelihoods with different stamps; it remembers the order of arrival too."""

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._by_arrival: dict[int, PoseLikelihood] = {}

    def __len__(self) -> int:
        return len(self._stamps)

    def copy(self) -> Self:
        """One of its own with the same likelihoods."""
        other = type(self)()
        other._stamps, other._by_arrival = self._stamps.copy(), self._by_arrival.copy()
        return other

    def get(self, stamp_ns: int) -> PoseLikelihood | None:
        """The likelihood with exactly this stamp."""
        return self._by_arrival.get(stamp_ns)

    def add(self, stamp_ns: int, likelihood: PoseLikelihood) -> None:
        """Keep a likelihood with a new stamp."""
        insort(self._stamps, stamp_ns)
        self._by_arrival[stamp_ns] = likelihood

    def remove(self, stamp_ns: int) -> None:
        """Drop the likelihood with exactly this stamp."""
        del self._by_arrival[stamp_ns], self._stamps[bisect_left(self._stamps, stamp_ns)]

    def next_after(self, stamp_ns: int) -> int | None:
        """The first stamp after another."""
        index = bisect_right(self._stamps, stamp_ns)
        return self._stamps[index] if index < len(self) else None

    def outside(self, first_ns: int, last_ns: int) -> list[int]:
        """Stamps before the first or after the last, in order of arrival."""
        if not self._stamps or (first_ns <= self._stamps[0] and self._stamps[-1] <= last_ns):
            return []
        return [stamp for stamp in self._by_arrival if not first_ns <= stamp <= last_ns]

    def forget_until(self, stamp_ns: int) -> list[int]:
        """Drop all up to a stamp and say which."""
        gone = self._stamps[: bisect_right(self._stamps, stamp_ns)]
        for stamp in gone:
            del self._by_arrival[stamp]
        del self._stamps[: len(gone)]
        return gone

    def to_tree(self) -> Tree:
        """Everything, for a file, in order of arrival."""
        return [
            {"stamp_ns": stamp, "likelihood": likelihood_tree(likelihood)}
            for stamp, likelihood in self._by_arrival.items()
        ]

    @classmethod
    def from_tree(cls, tree: Any) -> Self:
        """The buffer that was written."""
        buffer = cls()
        for entry in tree:
            buffer.add(entry["stamp_ns"], likelihood_from_tree(entry["likelihood"]))
        return buffer
