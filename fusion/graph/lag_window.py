"""LagWindow: the newest poses of a drive, all that binds them, and what is left of the poses before them.

A window never changes: what happens to it gives another one, so that whoever holds a window can go back to it.
"""

from dataclasses import dataclass, replace

import numpy as np

from fusion import se2
from fusion.arrays import FloatArray, IntArray
from fusion.errors import SkyfixError
from fusion.gaussian_likelihood import GaussianLikelihood
from fusion.gaussian_mixture import GaussianMixture
from fusion.graph.basins import around
from fusion.graph.chain_solver import solve_chain, without_first
from fusion.graph.covariances import positive_definite, turned
from fusion.graph.measurements import Measurement
from fusion.graph.patch import LikelihoodPatch, patch_of, without_outliers
from fusion.graph.sites import Sites
from fusion.likelihood import OutlierMixture
from fusion.odometry import OdometryIncrement

KeptMeasurement = GaussianMixture | LikelihoodPatch | OutlierMixture
"""An outlier mixture holds a Gaussian likelihood; any other gives a patch."""

_MOST_STEPS = 6
_TOLERANCE = 1e-4  # metres and radians; what is left is quadratic in it


@dataclass(frozen=True, slots=True, eq=False)
class LagWindow:
    """N poses in a row.

    Parameters
    ----------
    stamps : (N,) int64
        Strictly increasing.
    poses, covariances : (N, 3), (N, 3, 3) float64
        Estimate and marginals on the axes of the map.
    prior_mean, prior_covariance : (3,), (3, 3) float64
        What all that is gone says of the first pose, axes of the map.
    deltas, spreads : (N - 1, 3), (N - 1, 3, 3) float64
        Motions from each pose to the next.
    references, precisions, informations : (N, 3), (N, 3, 3), (N, 3) float64
        Sites, see `fusion.graph.sites`; zeros where nothing was measured.
    centres, widths : (N, 3), (N, 3, 3) float64
        The cavities under which the sites were found.
    measurements : tuple of N KeptMeasurement or None
        What was seen.
    """

    stamps: IntArray
    poses: FloatArray
    covariances: FloatArray
    prior_mean: FloatArray
    prior_covariance: FloatArray
    deltas: FloatArray
    spreads: FloatArray
    references: FloatArray
    precisions: FloatArray
    informations: FloatArray
    centres: FloatArray
    widths: FloatArray
    measurements: tuple[KeptMeasurement | None, ...]

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def measured(self) -> IntArray:
        """The places that have a measurement."""
        return np.array([k for k, one in enumerate(self.measurements) if one is not None], dtype=np.int64)

    def sites(self, places: IntArray) -> Sites:
        """Those of some places."""
        return Sites(self.references[places], self.precisions[places], self.informations[places])

    def with_sites(self, places: IntArray, sites: Sites, centres: FloatArray, widths: FloatArray) -> "LagWindow":
        """Other sites at some places, and the cavities under which they were found."""
        values = (sites.reference, sites.precision, sites.information, centres, widths)
        names = ("references", "precisions", "informations", "centres", "widths")
        fields = {name: getattr(self, name).copy() for name in names}
        for name, value in zip(names, values, strict=True):
            fields[name][places] = value
        return replace(self, **fields)

    def with_measurement(self, place: int, measurement: KeptMeasurement) -> "LagWindow":
        """A measurement at a place that had none, its site to be found."""
        measurements = (*self.measurements[:place], measurement, *self.measurements[place + 1 :])
        return replace(self, measurements=measurements)

    def extended(self, increment: OdometryIncrement) -> "LagWindow":
        """One more pose, as odometry predicts it; the others' marginals stay, for nothing new is said of them."""
        before, turn = self.poses[-1], self.poses[-1, 2]
        pose = se2.compose(before, increment.delta)
        spread = positive_definite(increment.covariance)
        by_before = np.eye(3)
        by_before[:2, 2] = before[1] - pose[1], pose[0] - before[0]
        covariance = by_before @ self.covariances[-1] @ by_before.T + turned(spread, turn)
        return self._with_place(len(self), increment.stamp_ns, pose, covariance, increment.delta[None], spread[None])

    def split(self, stamp_ns: int) -> "LagWindow":
        """One more pose between two: the motion is divided, see `divided`."""
        place = int(np.searchsorted(self.stamps, stamp_ns))
        before, after = self.stamps[place - 1 : place + 1].tolist()
        share = (stamp_ns - before) / (after - before)
        deltas, spreads = divided(self.deltas[place - 1], self.spreads[place - 1], share)
        moved = se2.between(self.poses[place - 1], self.poses[place])
        pose = se2.compose(self.poses[place - 1], se2.exp(share * se2.log(moved)))
        guess = self.covariances[place]  # until the chain is solved
        return self._with_place(place, stamp_ns, pose, guess, deltas, spreads)

    def _with_place(
        self,
        place: int,
        stamp_ns: int,
        pose: FloatArray,
        covariance: FloatArray,
        deltas: FloatArray,
        spreads: FloatArray,
    ) -> "LagWindow":
        """A pose at a place, with the motions (1 or 2, 3) into it and out of it."""

        def grown(array: FloatArray, value: FloatArray) -> FloatArray:
            return np.concatenate([array[:place], value[None], array[place:]])

        nothing, zeros = np.zeros(3), np.zeros((3, 3))
        return LagWindow(
            np.insert(self.stamps, place, stamp_ns),
            grown(self.poses, pose),
            grown(self.covariances, covariance),
            self.prior_mean,
            self.prior_covariance,
            np.concatenate([self.deltas[: place - 1], deltas, self.deltas[place:]]),
            np.concatenate([self.spreads[: place - 1], spreads, self.spreads[place:]]),
            grown(self.references, nothing),
            grown(self.precisions, zeros),
            grown(self.informations, nothing),
            grown(self.centres, nothing),
            grown(self.widths, zeros),
            (*self.measurements[:place], None, *self.measurements[place:]),
        )

    def shortened(self, most: int, huber_width: float) -> "LagWindow":
        """At most so many poses: the oldest are summed over, what they say of the next becomes its prior."""
        window = self
        while len(window) > most:
            mean, covariance = np.empty(3), np.empty((3, 3))
            without_first(
                window.poses[:2],
                window.prior_mean,
                window.prior_covariance,
                window.deltas[0],
                window.spreads[0],
                huber_width,
                window.references[0],
                window.precisions[0],
                window.informations[0],
                mean,
                covariance,
            )
            rest = {name: getattr(window, name)[1:] for name in LagWindow.__slots__ if not name.startswith("prior")}
            window = LagWindow(prior_mean=mean, prior_covariance=covariance, **rest)
        return window

    def solved(self, huber_width: float) -> "LagWindow":
        """Poses and marginals with the sites as they are.

        Raises
        ------
        SkyfixError
            When the result is not finite.
        """
        poses, covariances = self.poses.copy(), np.empty_like(self.covariances)
        solve_chain(
            poses,
            self.prior_mean,
            self.prior_covariance,
            self.deltas,
            self.spreads,
            huber_width,
            self.references,
            self.precisions,
            self.informations,
            _MOST_STEPS,
            _TOLERANCE,
            covariances,
        )
        if not (np.isfinite(poses).all() and np.isfinite(covariances).all()):
            raise SkyfixError("fixed lag: expected a finite solution, got NaN or an infinity")
        return replace(self, poses=poses, covariances=covariances)


def divided(delta: FloatArray, spread: FloatArray, share: float) -> tuple[FloatArray, FloatArray]:
    """A motion (3,) and its covariance (3, 3) in two parts, (2, 3), (2, 3, 3): at constant twist, covariance by time.

    The covariances of both parts are such that together they have exactly that of the whole.
    """
    first = se2.exp(share * se2.log(delta))
    second = se2.between(first, delta)
    by_first = np.eye(3)
    by_first[:2, 2] = first[1] - delta[1], delta[0] - first[0]
    back = np.linalg.inv(by_first)
    parts = [share * back @ spread @ back.T, (1.0 - share) * turned(spread, -first[2])]
    return np.array([first, second]), positive_definite(np.array(parts))


def kept_measurement(likelihood: Measurement, pose: FloatArray, covariance: FloatArray) -> KeptMeasurement:
    """What a smoother keeps of a likelihood: of a volume the part that can matter to a pose (3,), (3, 3)."""
    if isinstance(likelihood, GaussianLikelihood):
        return likelihood.modes(1)
    if isinstance(likelihood, (GaussianMixture, LikelihoodPatch)):
        return likelihood
    if isinstance(likelihood, OutlierMixture) and isinstance(without_outliers(likelihood)[0], GaussianLikelihood):
        return likelihood
    return patch_of(likelihood, around(pose, covariance))


def first_window(stamp_ns: int, mean: FloatArray, covariance: FloatArray) -> LagWindow:
    """A window of one pose that has nothing but its prior."""
    one, square = np.zeros((1, 3)), np.zeros((1, 3, 3))
    return LagWindow(
        np.array([stamp_ns], dtype=np.int64),
        mean[None],
        covariance[None],
        mean,
        covariance,
        np.zeros((0, 3)),
        np.zeros((0, 3, 3)),
        one,
        square,
        one,
        one,
        square,
        (None,),
    )
