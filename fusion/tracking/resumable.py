"""What a tracker asks of a filter beyond filtering: to be copied, put back and reseeded."""

from typing import Any, Protocol

from fusion.pose_filter import PoseFilter


class ResumableFilter(PoseFilter, Protocol):
    """A pose filter whose state can be taken out and put back.

    A state is a dataclass whose fields are arrays, numbers and strings, so that it can be written to a file, or
    dataclasses that `fusion.tracking.state_tree` knows. It holds all that the filter's answers depend on, settings
    apart.
    """

    def state(self) -> Any:
        """A copy of all that the filter knows, which later steps do not touch."""
        ...

    def restore(self, state: Any) -> None:
        """Go back to a state; the state itself stays as it is."""
        ...

    def reseed(self, key: int) -> None:
        """Make all further randomness a function of `key`, an unsigned 64-bit integer."""
        ...
