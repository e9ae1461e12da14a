"""Embeddings of scans and of places on a map, in one space, contrasted so that a scan lies near its own place.

Harmonics of the rings about a place (`learned.ring_harmonics`) are projected order by order by complex matrices, one
set for scans and one for maps: to turn the scan still multiplies order m of its embedding by exp(-i m a), so that an
embedding of a few hundred numbers answers for all headings. `learned.place_training` trains the matrices.

Training it that way also deals with hubs, places that look a little like every scan and that a plain vote over a
whole map answers always (Radovanovic et al., "Hubs in space", JMLR 2010).
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field
from importlib import resources
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from fusion.errors import SkyfixError
from learned.ring_harmonics import RingHarmonics, at_headings

_COMPLEX = ("scan_weights", "map_weights")


@dataclass(frozen=True, slots=True, eq=False)
class PlaceEmbedding:
    """Projections of harmonics.

    Attributes
    ----------
    scan_weights, map_weights
        (M + 1, F, D) complex64, F features of a ring order.
    scan_mean, map_mean
        (F,) float32, taken off order 0 beforehand.
    harmonics
        What is projected.
    network
        SHA-256 of the weights of the network whose features these are.
    """

    scan_weights: Tensor
    map_weights: Tensor
    scan_mean: Tensor
    map_mean: Tensor
    network: str
    harmonics: RingHarmonics = field(default_factory=RingHarmonics)

    def __post_init__(self) -> None:
        orders, features, size = self.scan_weights.shape
        wanted = {
            "map_weights": (orders, features, size),
            "scan_mean": (features,),
            "map_mean": (features,),
        }
        for name, shape in wanted.items():
            if tuple(getattr(self, name).shape) != shape:
                raise SkyfixError(f"place embedding: expected {name} {shape}, got {tuple(getattr(self, name).shape)}")
        if orders != self.harmonics.orders + 1:
            raise SkyfixError(f"place embedding: expected {self.harmonics.orders + 1} orders, got {orders}")

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the network's weights and these, as they are kept on disk."""
        digest = hashlib.sha256(self.network.encode())
        for name in _COMPLEX:
            digest.update(torch.view_as_real(getattr(self, name)).half().contiguous().numpy().tobytes())
        for mean in (self.scan_mean, self.map_mean):
            digest.update(mean.half().numpy().tobytes())
        return digest.hexdigest()

    def of_scans(self, harmonics: Tensor) -> Tensor:
        """Embeddings (B, M + 1, D) of scans' harmonics (B, F, M + 1); of norm 1."""
        return _projected(harmonics, self.scan_mean, self.scan_weights)

    def of_places(self, harmonics: Tensor) -> Tensor:
        """Embeddings (N, M + 1, D) of the harmonics (N, F, M + 1) of places on a map; of norm 1."""
        return _projected(harmonics, self.map_mean, self.map_weights)

    def save(self, path: Path) -> None:
        """Write PATH (.safetensors)."""
        tensors = {name: torch.view_as_real(getattr(self, name)).half().contiguous() for name in _COMPLEX}
        tensors |= {"scan_mean": self.scan_mean.clone(), "map_mean": self.map_mean.clone()}
        facts = {"harmonics": json.dumps(asdict(self.harmonics)), "network": self.network}
        try:
            save_file(tensors, path, facts)
        except (OSError, SafetensorError) as error:
            raise SkyfixError(f"place embedding {path}: cannot be written: {error}") from error

    @classmethod
    def load(cls, path: Path) -> PlaceEmbedding:
        """Read what `save` wrote.

        Raises
        ------
        SkyfixError
            If the file is missing or something else.
        """
        try:
            with safe_open(path, "pt") as file:
                facts = file.metadata() or {}
                names = file.keys()
                tensors = {name: file.get_tensor(name).float() for name in names}
            tensors |= {name: torch.view_as_complex(tensors[name].contiguous()) for name in _COMPLEX}
            values = json.loads(facts["harmonics"])
            harmonics = RingHarmonics(**{**values, "rings_m": tuple(values["rings_m"])})
            return cls(**tensors, network=facts["network"], harmonics=harmonics)
        except (OSError, SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
            what = str(error).splitlines()[0]
            raise SkyfixError(f"place embedding {path.name}: expected a readable file, got: {what}") from error

    @classmethod
    def shipped(cls) -> PlaceEmbedding:
        """Of the shipped RotMatch's features."""
        with resources.as_file(resources.files("learned") / "weights" / "rotmatch_places.safetensors") as path:
            return cls.load(path)


def _projected(harmonics: Tensor, mean: Tensor, weights: Tensor) -> Tensor:
    centred = harmonics.clone()
    centred[:, :, 0] -= mean
    found = torch.einsum("nfm,mfd->nmd", centred, weights)
    norm = (found.abs().square().sum(-1) @ order_factors(found.shape[1])).sqrt()
    return found / norm.clamp(min=1e-9)[:, None, None]


def order_factors(count: int) -> Tensor:
    """k_m: every order above zero stands for its conjugate too."""
    factors = torch.full((count,), 2.0)
    factors[0] = 1.0
    return factors


def similarities(scan: Tensor, places: Tensor, headings: int) -> Tensor:
    """Scores (N, headings) of one scan's embedding (M + 1, D) at places (N, M + 1, D), at yaws 2 pi k / headings."""
    products = (places * scan.conj()).sum(-1)
    return at_headings(products * order_factors(len(scan)), headings)
