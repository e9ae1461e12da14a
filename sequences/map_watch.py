"""Is the vehicle still where the filter has it? Asked of the whole map now and then.

A likelihood over a narrow search cannot tell: on a straight road the next straight road fits as well, and normalised
over the search alone both are certain. So at times the scan is scored against all of the map. The contrast

    r = max over the map of ln L  -  max near the filter's pose of ln L

is mostly nothing and at times a few nats for a vehicle on track, since the best of millions of wrong poses beats the
right one by chance, and much for one that is elsewhere. It enters a hidden Markov model of two states,
`fusion.particles.lost`, with what chance alone can do taken off, and bounded: no scan decides alone.
"""

from __future__ import annotations

import math

from fusion.particles.lost import LostModel, probability

_BY_CHANCE_NATS = 3.0
_MOST_NATS = 4.0  # that one scan can speak for being elsewhere: its errors may be gross
_SUSPICION = 0.01
_LEAST_AREA_M2 = 1e6
_PROBATION_M, _PROBATION_EVERY_M = 100.0, 4.0


class MapWatch:
    """The probability that the vehicle is elsewhere on the map.

    A place that was found on the whole map is on probation: for 100 m, scans are compared however `every_m` is set.

    Parameters
    ----------
    every_m
        A scan is compared with the whole map every so many metres, 0 for no more than the probation; more rarely on
        maps above 1 km^2, in proportion. Every scan is, as soon as one gave rise to suspicion.
    area_m2
        Of the map.
    """

    def __init__(self, every_m: float, area_m2: float) -> None:
        self._every_m = (every_m or _PROBATION_EVERY_M) * max(1.0, area_m2 / _LEAST_AREA_M2)
        self._until_m = math.inf if every_m > 0.0 else -math.inf
        self._model = LostModel()
        self._asked_at_m = 0.0
        self.lost = self._model.kidnap_probability

    def is_due(self, way_m: float) -> bool:
        """Whether to compare at this metre of the drive."""
        is_suspicious = self.lost > _SUSPICION
        return is_suspicious or (way_m < self._until_m and way_m - self._asked_at_m >= self._every_m)

    def record(self, way_m: float, contrast_nats: float) -> float:
        """Take in a comparison; the probability of being elsewhere after it."""
        self._asked_at_m = way_m
        self.lost = probability(self._model.log_odds(self.lost, 0.0, min(contrast_nats - _BY_CHANCE_NATS, _MOST_NATS)))
        return self.lost

    def restart(self, way_m: float, lost: float) -> None:
        """Begin anew: the vehicle has been looked for on the whole map, and is elsewhere with this probability."""
        self._asked_at_m, self.lost = way_m, max(lost, self._model.kidnap_probability)
        self._until_m = max(self._until_m, way_m + _PROBATION_M)
