"""What a network must offer to be trained, validated, saved and used: the interface that `skyfix train` speaks.

A network is an `nn.Module` with `settings`, `losses` and `truth_nll`; an `Architecture` says how it is built from its
settings and turned into a matcher. `learned.architectures.ARCHITECTURES` lists them. Training knows nothing else.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Protocol, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from fusion.likelihood import LikelihoodVolume
from learned.bev import BevSettings
from learned.calibration import Calibration
from learned.map_raster import MapRaster
from learned.matcher import MapMatcher, SearchRegion
from learned.samples import SAMPLE_METRES_PER_PIXEL, Example


@dataclass(frozen=True, slots=True)
class Batch:
    """Examples side by side.

    Attributes
    ----------
    density
        (B, bands, n, n) float32 log densities of the scans, body frame (see `learned.bev`).
    picture
        (B, 3, m, m) float32 in [0, 1], the map crops.
    row, col
        (B,) float64: where the vehicles truly are, continuous pixel coordinates of the crops (integers are edges).
    yaw
        (B,) float64 true headings, radians.
    prior_yaw
        (B,) float64 headings known beforehand: the truth plus a uniform error.
    metres_per_pixel
        Of pictures and scans alike.
    first
        Number of the first example within the step's whole batch; above zero only where several processes share it.
        A network that draws once an example skips that many draws, so that the processes see what one would have.
    place
        (B, 2) float64: where the samples were taken, metres in one frame, NaN where that is not known; or None.
    """

    density: Tensor
    picture: Tensor
    row: Tensor
    col: Tensor
    yaw: Tensor
    prior_yaw: Tensor
    metres_per_pixel: float = SAMPLE_METRES_PER_PIXEL
    first: int = 0
    place: Tensor | None = None

    def __len__(self) -> int:
        return len(self.density)

    @classmethod
    def of(cls, examples: Sequence[Example], first: int = 0) -> Self:
        """Collate examples; at least one."""
        row, col, yaw, prior_yaw = (
            torch.tensor([getattr(example, name) for example in examples], dtype=torch.float64)
            for name in ("row", "col", "yaw", "prior_yaw")
        )
        density = torch.from_numpy(np.stack([example.density for example in examples]))
        picture = torch.stack([picture_tensor(example.picture) for example in examples])
        place = torch.tensor([example.place for example in examples], dtype=torch.float64)
        return cls(density, picture, row, col, yaw, prior_yaw, first=first, place=place)

    def to(self, device: torch.device) -> Self:
        """The same on another device."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        moved: dict[str, Any] = {name: v.to(device) for name, v in values.items() if isinstance(v, Tensor)}
        return replace(self, **moved)


class NetworkSettings(Protocol):
    """A network's sizes: a frozen dataclass whose fields pydantic can read back from JSON."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def bev(self) -> BevSettings:
        """The bird's-eye view that the network is given."""
        ...


class LocalizationNet(Protocol):
    """An `nn.Module` that says how likely poses are; implement `settings`, `losses`, `truth_nll`, inherit the rest.

    `losses` runs under autocast where the training's precision asks for it; a part that needs float32 (FFTs, large
    sums) turns it off with ``torch.autocast(device_type, enabled=False)``. Random numbers come from `generator` (on the
    CPU) alone, or from torch's global generator, which is seeded anew at every step.
    """

    @property
    def settings(self) -> NetworkSettings:
        """What it was built from."""
        ...

    def losses(self, batch: Batch, generator: torch.Generator) -> dict[str, Tensor]:
        """Scalar terms by name, each a mean over the batch; "total" is minimised, the others are logged."""
        ...

    def truth_nll(self, batch: Batch, generator: torch.Generator) -> Tensor:
        """(B,) negative log density, per m^2 rad, of the true poses under the likelihood over the crop.

        The density integrates to one over the positions that are scored and the headings that are searched, so
        that networks can be compared by it.
        """
        ...

    def parameters(self, recurse: bool = True) -> Iterator[nn.Parameter]:
        """As `nn.Module.parameters`."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """As `nn.Module.state_dict`."""
        ...

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False) -> Any:
        """As `nn.Module.load_state_dict`."""
        ...

    def train(self, mode: bool = True) -> Any:
        """As `nn.Module.train`."""
        ...

    def eval(self) -> Any:
        """As `nn.Module.eval`."""
        ...

    def to(self, device: torch.device) -> Any:
        """As `nn.Module.to`."""
        ...


class NetworkMatcher(MapMatcher, Protocol):
    """A matcher made of a network and a calibration."""

    @property
    def net(self) -> LocalizationNet:
        """The network."""
        ...

    @property
    def calibration(self) -> Calibration:
        """What was fitted on held-out data."""
        ...

    def match_counts(
        self, counts: NDArray[np.float32], map_raster: MapRaster, search: SearchRegion
    ) -> LikelihoodVolume:
        """Match a bird's-eye view (bands, n, n) of point counts that has been made already."""
        ...


@dataclass(frozen=True, slots=True)
class Architecture:
    """A kind of network.

    Attributes
    ----------
    name
        As configurations call it; checkpoints say "NAME-VERSION".
    settings_type
        Frozen dataclass with a `bev: BevSettings` and a default for every field.
    build
        Settings -> network with fresh weights, drawn from torch's global generator.
    matcher
        (network, calibration) -> matcher.
    reaching
        (network, half extent in metres) -> network with the same weights for scans of another reach; None where the
        weights fit one reach alone.
    version
        Raised when weights of before no longer fit.
    factored
        Whether the heading is predicted apart from the position, so that its calibration gets a parameter of its own.
    needs_heading
        Whether the scan is turned by the heading known beforehand, so that it has to be known as well as in training;
        others vote over all headings.
    pretrained_by
        Architectures whose checkpoints can start a training of this one, and the modules that are then taken over.
    """

    name: str
    settings_type: type[Any]
    build: Callable[[Any], LocalizationNet]
    matcher: Callable[[Any, Calibration], NetworkMatcher]
    reaching: Callable[[Any, float], LocalizationNet] | None = None
    version: int = 1
    factored: bool = False
    needs_heading: bool = False
    pretrained_by: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def tag(self) -> str:
        """What a checkpoint of this architecture says."""
        return f"{self.name}-{self.version}"


def picture_tensor(picture: NDArray[np.uint8]) -> Tensor:
    """(rows, cols, 3) uint8 -> (3, rows, cols) float32 in [0, 1]."""
    return torch.from_numpy(np.ascontiguousarray(picture.transpose(2, 0, 1))).float() / 255.0


def on_cpu(net: LocalizationNet) -> LocalizationNet:
    """The network itself if it is on the CPU, else a copy that is."""
    if all(parameter.device.type == "cpu" for parameter in net.parameters()):
        return net
    copied = copy.deepcopy(net)
    copied.to(torch.device("cpu"))
    return copied
