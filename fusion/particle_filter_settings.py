"""What can be chosen about the particle filter, with the defaults of the trackers."""

from dataclasses import dataclass
from math import isfinite

from fusion.errors import SkyfixError
from fusion.lost import LostModel
from fusion.resampling import RESAMPLERS


@dataclass(frozen=True, slots=True)
class ParticleFilterSettings:
    """How the filter behaves.

    Parameters
    ----------
    resampler : str
        Name in `fusion.resampling.RESAMPLERS`.
    ess_fraction : float
        Resample when the effective sample size falls below this share of the particles, in [0, 1].
    outlier_probability : float
        Chance that a measurement is about nothing, in (0, 1); bounds what one measurement can do.
    regularisation : float
        Kernel noise after resampling, in units of Silverman's bandwidth, in [0, 1]; 0 switches it off.
    kidnap_probability : float
        Chance of getting lost between two measurements, in (0, 1).
    recovery_probability : float
        Chance of being on track again at the next measurement once lost, in (0, 1).
    collapse_log_evidence_margin : float
        Inject particles when being lost is ahead of being on track by this many nats.
    injection_share : float
        Share of the particles that is injected then, in [0, 1); 0 switches recovery off.
    threads : int
        Threads that share the work on large clouds, at least 1; the result does not depend on it.

    Raises
    ------
    SkyfixError
        When a value is out of range or the resampler unknown.
    """

    resampler: str = "systematic"
    ess_fraction: float = 0.5
    outlier_probability: float = 0.05
    regularisation: float = 0.5
    kidnap_probability: float = 1e-3
    recovery_probability: float = 0.1
    collapse_log_evidence_margin: float = 1.0
    injection_share: float = 0.25
    threads: int = 1

    def __post_init__(self) -> None:
        if self.resampler not in RESAMPLERS:
            raise SkyfixError(f"resampler: expected one of {', '.join(RESAMPLERS)}, got {self.resampler!r}")
        for name in ("ess_fraction", "regularisation"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise SkyfixError(f"{name}: expected in [0, 1], got {getattr(self, name)}")
        if not 0.0 < self.outlier_probability < 1.0:
            raise SkyfixError(f"outlier_probability: expected in (0, 1), got {self.outlier_probability}")
        LostModel(self.kidnap_probability, self.recovery_probability)  # checks both
        if self.threads < 1:
            raise SkyfixError(f"threads: expected at least 1, got {self.threads}")
        if not 0.0 <= self.injection_share < 1.0:
            raise SkyfixError(f"injection_share: expected in [0, 1), got {self.injection_share}")
        if not isfinite(self.collapse_log_evidence_margin):
            raise SkyfixError(
                f"collapse_log_evidence_margin: expected a number, got {self.collapse_log_evidence_margin}"
            )
