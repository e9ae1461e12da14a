"""What can be chosen about the particle filter, with the defaults of the trackers."""

from dataclasses import dataclass
from math import isfinite

from fusion.arrays import keep_plain
from fusion.errors import SkyfixError
from fusion.particles.kld_sampling import KldSampling
from fusion.particles.lost import LostModel
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
    guided_share, guided_below : float
        A measurement that would leave fewer than `guided_below` effective particles (>= 0; infinity: any), or that all
        particles seem to have missed, is weighed again, with this share of the particles, in [0, 1), drawn from it
        instead of the prediction; see `fusion.particles.guided_proposal`. So a thousand particles stand a start known
        to 20 m and a likelihood sharp to decimetres. It costs far more than a plain step. Either at 0: never.
    adaptive : KldSampling or None
        Choose the number of particles anew at every measurement, which then always resamples.
    standstill_m, standstill_rad : float
        A measurement after less motion than both since the last one that counted is left out, and nothing is
        resampled; 0 and 0 take every one. With errors that are correlated over a length L a measurement d later is
        worth tanh(d / 2 L) of an independent one (`correlated_error_temperature`), so d = L / 25 leaves out what is
        worth less than 2 %: standing still adds no information and only wears a cloud out.
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
    guided_share: float = 0.5
    guided_below: float = 50.0
    adaptive: KldSampling | None = None
    standstill_m: float = 0.0
    standstill_rad: float = 0.0
    threads: int = 1

    def __post_init__(self) -> None:
        keep_plain(self, self.__slots__)
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
        for name in ("injection_share", "guided_share"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise SkyfixError(f"{name}: expected in [0, 1), got {getattr(self, name)}")
        for name in ("standstill_m", "standstill_rad"):
            if not (isfinite(getattr(self, name)) and getattr(self, name) >= 0.0):
                raise SkyfixError(f"{name}: expected >= 0, got {getattr(self, name)}")
        if not self.guided_below >= 0.0:
            raise SkyfixError(f"guided_below: expected >= 0, got {self.guided_below}")
        if not isfinite(self.collapse_log_evidence_margin):
            raise SkyfixError(
                f"collapse_log_evidence_margin: expected a number, got {self.collapse_log_evidence_margin}"
            )
