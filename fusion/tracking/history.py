"""Snapshots of a filter along the recent past, from which to go on again when something late arrives."""

from bisect import bisect_right
from dataclasses import dataclass, field
from typing import Any

from fusion.error_memory import ErrorMemory
from fusion.tracking.archive import Tree
from fusion.tracking.state_tree import state_tree, state_values


@dataclass(frozen=True, slots=True, eq=False)
class Node:
    """A time to which the filter has been moved.

    Parameters
    ----------
    stamp_ns : int
        When; `BEGINNING` for the filter as it started, at no time in particular.
    state : dataclass
        The filter's, after moving there and after the measurement there, if any.
    distance_m : float or None
        Driven since the last measurement; None when there has been none.
    memory : ErrorMemory
        What measurements so far have in common with the filter's error.
    """

    stamp_ns: int
    state: Any
    distance_m: float | None
    memory: ErrorMemory = field(default_factory=ErrorMemory)

    def to_tree(self) -> dict[str, Tree]:
        """Everything, for a file."""
        state = state_tree(self.state)
        memory: dict[str, Tree] = {"shared": self.memory.shared, "log_variance": self.memory.log_variance}
        return {"stamp_ns": self.stamp_ns, "distance_m": self.distance_m, "memory": memory, "state": state}


class History:
    """Nodes in order of time; there is always one.

    Parameters
    ----------
    nodes : list of Node
        At least one, with increasing stamps.
    """

    def __init__(self, nodes: list[Node]) -> None:
        self._nodes = list(nodes)
        self._stamps = [node.stamp_ns for node in nodes]

    def __len__(self) -> int:
        return len(self._nodes)

    def copy(self) -> "History":
        """One of its own with the same nodes."""
        return History(self._nodes)

    @property
    def base(self) -> Node:
        """The oldest node."""
        return self._nodes[0]

    @property
    def head(self) -> Node:
        """The newest node."""
        return self._nodes[-1]

    def append(self, node: Node) -> None:
        """Add a node after all others."""
        self._nodes.append(node)
        self._stamps.append(node.stamp_ns)

    def at_or_before(self, stamp_ns: int) -> Node | None:
        """The last node that is not after a stamp."""
        index = bisect_right(self._stamps, stamp_ns)
        return self._nodes[index - 1] if index else None

    def take_back(self, after_ns: int) -> int:
        """Drop the nodes after a stamp, which is not before the base, and say how many."""
        index = bisect_right(self._stamps, after_ns)
        count = len(self) - index
        del self._nodes[index:], self._stamps[index:]
        return count

    def forget_before(self, stamp_ns: int) -> None:
        """Drop the nodes that going back to `stamp_ns` does not need."""
        count = bisect_right(self._stamps, stamp_ns) - 1
        if count > 0:
            del self._nodes[:count], self._stamps[:count]

    def to_tree(self) -> Tree:
        """Everything, for a file."""
        return [node.to_tree() for node in self._nodes]


def history_from_tree(tree: Any, state_type: type) -> History:
    """The history that was written, of a filter whose states are of a given type."""
    return History(
        [
            Node(
                entry["stamp_ns"],
                state_type(**state_values(entry["state"])),
                entry["distance_m"],
                ErrorMemory(**entry["memory"]),
            )
            for entry in tree
        ]
    )
