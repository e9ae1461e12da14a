"""Made-up streams for the tracker: a drive with odometry and measurements, and a Kalman filter to track it with."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from fusion import Arrival, Estimate, GaussianLikelihood, MapGrid, OdometryIncrement, Tracker, UpdateReport, se2
from fusion.arrays import FloatArray

SECOND = 10**9
START = 1_700_000_000 * SECOND
GRID = MapGrid(300, 300, 1.0, -150.0, -150.0)
SIGMA = np.array([0.5, 0.5, 0.02])


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """One message: odometry when the content is an array, else a likelihood."""

    stamp_ns: int
    content: FloatArray | GaussianLikelihood

    @property
    def is_odometry(self) -> bool:
        return isinstance(self.content, np.ndarray)

    def moved(self, by_ns: int) -> Message:
        return replace(self, stamp_ns=self.stamp_ns + by_ns)


def truth_at(stamp_ns: int) -> FloatArray:
    """The vehicle at a time: 10 m/s on a wide circle, from the origin at `START`."""
    return se2.exp(np.array([10.0, 0.0, 0.1]) * (stamp_ns - START) / SECOND)


def odometry_at(stamp_ns: int) -> FloatArray:
    """What odometry says: another frame, one per cent too far, and a heading that drifts."""
    seconds = (stamp_ns - START) / SECOND
    return se2.compose(np.array([700.0, -300.0, 2.0]), se2.exp(np.array([10.1, 0.0, 0.102]) * seconds))


def measurement(stamp_ns: int, rng: np.random.Generator, pose: FloatArray | None = None) -> GaussianLikelihood:
    """A likelihood around the truth, or around another pose."""
    centre = truth_at(stamp_ns) if pose is None else pose
    return GaussianLikelihood(centre + rng.normal(0.0, SIGMA), np.diag(SIGMA**2), GRID)


def streams(seconds: float = 4.0, hertz: float = 20.0, every_s: float = 0.5, seed: int = 0) -> list[Message]:
    """Messages of a drive in order of time; measurements fall between the odometry's stamps."""
    rng = np.random.default_rng(seed)
    odometry = [START + round(i * SECOND / hertz) for i in range(round(seconds * hertz) + 1)]
    measured = [START + round((i + 0.31) * every_s * SECOND) for i in range(round(seconds / every_s))]
    messages = [Message(stamp, odometry_at(stamp)) for stamp in odometry]
    messages += [Message(stamp, measurement(stamp, rng)) for stamp in measured]
    return sorted(messages, key=lambda message: message.stamp_ns)


def shuffled(messages: list[Message], delays_ms: Iterable[int]) -> list[Message]:
    """The messages in order of arrival, each as much later as its delay says."""
    arrivals = [message.stamp_ns + delay * SECOND // 1000 for message, delay in zip(messages, delays_ms, strict=True)]
    return [messages[index] for index in np.argsort(arrivals, kind="stable")]


def feed(tracker: Tracker, messages: Iterable[Message]) -> list[Arrival]:
    """Give messages to a tracker, one after the other."""
    return [
        tracker.add_odometry(message.stamp_ns, message.content)
        if message.is_odometry
        else tracker.add_likelihood(message.stamp_ns, message.content)
        for message in messages
    ]


def answers(tracker: Tracker, at_ns: Iterable[int]) -> FloatArray:
    """Everything a tracker says at some times, a row each."""
    rows = []
    for stamp in at_ns:
        estimate = tracker.estimate(stamp)
        numbers = [estimate.effective_sample_size, estimate.log_evidence, estimate.lost_score]
        rows.append(np.concatenate([estimate.pose, estimate.covariance.ravel(), numbers]))
    return np.array(rows)


@dataclass(frozen=True, slots=True, eq=False)
class KalmanState:
    """Mean and covariance."""

    mean: FloatArray
    covariance: FloatArray
    log_evidence: float


class KalmanFilter:
    """An extended Kalman filter for Gaussian likelihoods, with no randomness, as a `ResumableFilter`."""

    def __init__(self, mean: FloatArray, covariance: FloatArray) -> None:
        self.current = KalmanState(np.asarray(mean, dtype=float), covariance, 0.0)

    def predict(self, increment: OdometryIncrement) -> None:
        mean, turn = self.current.mean, se2.rotation(self.current.mean[2])
        moved = se2.compose(mean, increment.delta)
        jacobian = np.eye(3)
        jacobian[:2, 2] = [-(moved[1] - mean[1]), moved[0] - mean[0]]
        covariance = jacobian @ self.current.covariance @ jacobian.T + turn @ increment.covariance @ turn.T
        self.current = KalmanState(moved, covariance, self.current.log_evidence)

    def update(self, likelihood: GaussianLikelihood, temperature: float = 1.0) -> UpdateReport:
        noise = temperature * likelihood.covariance
        innovation = likelihood.mean - self.current.mean
        innovation[2] = se2.wrap(innovation[2])
        spread = self.current.covariance + noise
        gain = self.current.covariance @ np.linalg.inv(spread)
        log_evidence = -0.5 * (
            innovation @ np.linalg.solve(spread, innovation) + np.linalg.slogdet(2.0 * np.pi * spread)[1]
        )
        mean = self.current.mean + gain @ innovation
        mean[2] = se2.wrap(mean[2])
        covariance = (np.eye(3) - gain) @ self.current.covariance
        self.current = KalmanState(mean, 0.5 * (covariance + covariance.T), float(log_evidence))
        return UpdateReport(float(log_evidence), 1.0)

    def estimate(self, stamp_ns: int, max_modes: int = 0) -> Estimate:
        state = self.current
        return Estimate(stamp_ns, state.mean, state.covariance, None, 1.0, state.log_evidence, 0.0)

    def state(self) -> KalmanState:
        return self.current

    def restore(self, state: KalmanState) -> None:
        self.current = state

    def reseed(self, key: int) -> None:
        assert 0 <= key < 2**64
