"""RotMatch on one core: its encoders in torch and in the runtimes that are installed, voting, and all of a match.

The sizes are those of a match: the shipped reach of 72 m and a search of 20 m, so that a scan is 288 pixels wide and
a map 368. The 8-bit graphs get their ranges from the images that they are timed on; what rounding costs in accuracy
is measured on drives by `skyfix evaluate`, not here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from importlib.util import find_spec

import torch
from torch import Tensor

from benchmarks.runner import Candidate, Case
from learned.backends import BACKENDS, Backend
from learned.correlation import correlate
from learned.export import encoder_graphs, quantised
from learned.exported import ExportedRotMatch
from learned.rotmatch import RotMatch, RotMatchNet
from learned.voting import bin_yaws, rotate_templates, vote
from learned.voting_net import CROP_MULTIPLE

SEED = 0
YAW_BINS = 360
HEADINGS = (21, YAW_BINS)
"""A search of +-10 degrees, and one of the whole circle."""

Net = RotMatchNet | ExportedRotMatch


def example_images(net: RotMatchNet, position_half_m: float) -> tuple[Tensor, Tensor]:
    """A scan (1, bands, n, n), mostly empty as scans are, and a map of blocks (1, 3, m, m)."""
    generator = torch.Generator().manual_seed(SEED)
    bev = net.settings.bev
    side = CROP_MULTIPLE * math.ceil((bev.size + 2 * position_half_m / bev.metres_per_pixel) / CROP_MULTIPLE)
    density = torch.rand(1, 4, bev.size, bev.size, generator=generator)
    blocks = torch.rand(1, 3, side // CROP_MULTIPLE, side // CROP_MULTIPLE, generator=generator)
    return density * (density > 0.9), torch.nn.functional.interpolate(blocks, size=side)


def networks(net: RotMatchNet, density: Tensor, picture: Tensor) -> dict[str, Net]:
    """The network in torch and in every backend that is installed, by the name to list it under."""
    found: dict[str, Net] = {"skyfix RotMatch, torch": net}
    if find_spec("onnx") is None:
        return found
    graphs = {"fp32": encoder_graphs(net)}
    if all(find_spec(package) for package in ("onnx", "onnxruntime")):
        images = {"scan": density.numpy(), "map": picture.numpy()}
        graphs["int8"] = {name: quantised(graph, [images[name]]) for name, graph in graphs["fp32"].items()}
    for backend in BACKENDS.values():
        if backend.installed and backend.weights in graphs:
            found[f"skyfix RotMatch, {backend.name}"] = _exported(net, graphs[backend.weights], backend)
    return found


def _exported(net: RotMatchNet, graphs: Mapping[str, bytes], backend: Backend) -> ExportedRotMatch:
    return ExportedRotMatch(net.settings, backend.session(graphs["scan"]), backend.session(graphs["map"]))


def encode(net: Net, density: Tensor, picture: Tensor) -> tuple[Tensor, Tensor]:
    """Features of the scan and of the map."""
    with torch.inference_mode():
        return net.scan_features(density), net.map_features(picture)


def match(net: Net, density: Tensor, picture: Tensor, yaws: Tensor) -> Tensor:
    """Scores (R, rows, cols): encoders and voting."""
    with torch.inference_mode():
        return net.pose_scores(density[0], picture[0], yaws)


def plain_vote(found: Tensor, scan: Tensor, yaws: Tensor) -> Tensor:
    """What `learned.voting.vote` gives, by turning and transforming every heading: 16 at a time, for the memory."""
    with torch.inference_mode():
        return torch.cat([correlate(found, rotate_templates(scan, block)) for block in yaws.split(16)])


def quick_vote(found: Tensor, scan: Tensor, yaws: Tensor) -> Tensor:
    """`learned.voting.vote` without gradients."""
    with torch.inference_mode():
        return vote(found, scan, yaws)


def cases(
    net: RotMatchNet | None = None, position_half_m: float = 20.0, headings: Sequence[int] = HEADINGS
) -> Iterator[Case]:
    """Encoders (the size is the scan's side in pixels), voting and matches (the number of headings).

    Where no other runtime than torch is installed there is nothing to compare but voting.
    """
    if net is None:
        net = RotMatch.shipped().net
    net = net.eval()
    density, picture = example_images(net, position_half_m)
    nets = networks(net, density, picture)
    if len(nets) > 1:
        encoders = {name: partial(encode, one, density, picture) for name, one in nets.items()}
        yield _case("RotMatch: encoders", net.settings.bev.size, encoders)
    scan, found = (features[0] for features in encode(net, density, picture))
    for count in headings:
        yaws = bin_yaws([(k - count // 2) % YAW_BINS for k in range(count)], YAW_BINS)
        votes = {"skyfix vote": quick_vote, "every heading turned and transformed": plain_vote}
        yield _case("RotMatch: voting", count, {name: partial(work, found, scan, yaws) for name, work in votes.items()})
        if len(nets) > 1:
            matches = {name: partial(match, one, density, picture, yaws) for name, one in nets.items()}
            yield _case("RotMatch: match", count, matches)


def _case(name: str, size: int, works: Mapping[str, Callable[[], object]]) -> Case:
    return Case(name, size, tuple(Candidate(what, partial(_again, work)) for what, work in works.items()))


def _again(work: Callable[[], object]) -> Callable[[], object]:
    """Nothing is kept of a run."""
    return work
