"""What a tracker says of a message it was given, and of all of them together."""

from dataclasses import dataclass
from enum import StrEnum

from fusion.pose_filter import UpdateReport


class Outcome(StrEnum):
    """What became of one message."""

    USED = "used"
    WAITING = "waiting"
    """A likelihood that odometry does not cover yet."""
    WITHHELD = "withheld"
    """Odometry far ahead of everything else, until more of it comes."""
    TOO_LATE = "too late"
    DUPLICATE = "duplicate"
    """The same stamp and the same content as one before."""
    CONFLICT = "conflict"
    """The same stamp as one before and other content; the first is kept."""


@dataclass(frozen=True, slots=True)
class Measured:
    """One likelihood's effect on the filter.

    Parameters
    ----------
    stamp_ns : int
        Its time.
    temperature : float
        By which it was flattened for errors shared with the measurement before.
    update : UpdateReport
        The filter's own words.
    evidence_gain_nats : float
        By how much the prediction explains it better than a pose drawn at random from what was searched. The median
        over many measurements says whether scans, map and track belong together: with RotMatch it is 3.6 and more
        where they do, and below 3 where they do not, whatever covariance and lost score say.
    """

    stamp_ns: int
    temperature: float
    update: UpdateReport
    evidence_gain_nats: float


@dataclass(frozen=True, slots=True)
class Arrival:
    """What one message did.

    Parameters
    ----------
    stamp_ns : int
        Its time.
    outcome : Outcome
        What became of it.
    measured : tuple of Measured
        Likelihoods that the filter was weighed by in consequence, in order of time; after a late message also those
        that were done again.
    replayed : int
        Number of the filter's steps that were taken back and done again.
    lost_ns : tuple of int
        Stamps of likelihoods that were given up in consequence: never covered by odometry, pushed out of the queue, or
        refused by the filter.
    """

    stamp_ns: int
    outcome: Outcome
    measured: tuple[Measured, ...] = ()
    replayed: int = 0
    lost_ns: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class Statistics:
    """Counts since a tracker began, and what it holds now.

    Parameters
    ----------
    odometry, likelihoods : int
        Messages taken in, those waiting included.
    late_odometry, late_likelihoods : int
        Of these, how many came after newer odometry, or after the filter had stepped to their time or beyond.
    too_late_odometry, too_late_likelihoods : int
        Messages older than the history.
    duplicates, conflicts : int
        Messages with a stamp that was there already, the same in content or not.
    gaps, resets, clock_jumps : int
        Motions of these kinds, see `fusion.odometry_limits`.
    dismissed_odometry : int
        Withheld messages far ahead of the others whose clock was not believed.
    uncovered_likelihoods : int
        Given up because odometry never covered them within the history.
    overflowed_likelihoods : int
        Pushed out of the full queue of those that wait.
    rejected_likelihoods : int
        Given up because the filter refused them once odometry covered them.
    replayed_steps : int
        Steps of the filter that were taken back.
    held_odometry, held_likelihoods, held_states, waiting, withheld : int
        Messages and states of the filter in memory now; waiting likelihoods are among those held.
    """

    odometry: int = 0
    likelihoods: int = 0
    late_odometry: int = 0
    late_likelihoods: int = 0
    too_late_odometry: int = 0
    too_late_likelihoods: int = 0
    duplicates: int = 0
    conflicts: int = 0
    gaps: int = 0
    resets: int = 0
    clock_jumps: int = 0
    dismissed_odometry: int = 0
    uncovered_likelihoods: int = 0
    overflowed_likelihoods: int = 0
    rejected_likelihoods: int = 0
    replayed_steps: int = 0
    held_odometry: int = 0
    held_likelihoods: int = 0
    held_states: int = 0
    waiting: int = 0
    withheld: int = 0
