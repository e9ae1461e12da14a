"""RotMatch's encoders as ONNX graphs, for runtimes without torch's overhead; voting stays in torch.

An export is a folder: `scan.onnx` and `map.onnx` (normalisation, worth and scale of the features included; batch,
height and width are free), `export.json` (architecture, settings, calibration), and, where it was asked for,
`scan.int8.onnx` and `map.int8.onnx`: convolutions in 8 bits, the rest in float32 (Jacob et al., CVPR 2018), with
ranges taken from a few matches.
"""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from fusion.errors import SkyfixError
from learned.bev import BANDS_M
from learned.rotmatch import ARCHITECTURE, RotMatch, RotMatchNet
from learned.voting_net import CROP_MULTIPLE

FORMAT = 1
"""Of the folder; raised when it changes."""
GRAPHS = ("scan", "map")
INDEX = "export.json"
_OPSET = 17

Images = tuple[NDArray[np.float32], NDArray[np.float32]]
"""A scan's log densities (bands, n, n) and a map's picture (3, m, m)."""


class _Encoder(nn.Module):
    """One of the network's two methods as a module, which is what torch exports."""

    def __init__(self, net: RotMatchNet, features: Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self.net, self.features = net, features

    def forward(self, image: Tensor) -> Tensor:
        return self.features(image)


def encoder_graphs(net: RotMatchNet) -> dict[str, bytes]:
    """The two encoders as ONNX, {"scan": (B, bands, n, n) -> features, "map": (B, 3, H, W) -> features}.

    Sides are multiples of `CROP_MULTIPLE`, as in torch.

    Raises
    ------
    SkyfixError
        If the package onnx is missing.
    """
    if find_spec("onnx") is None:
        raise SkyfixError("export: expected the package onnx, got none installed: pip install 'skyfix[onnxruntime]'")
    side = 4 * CROP_MULTIPLE
    with torch.inference_mode(False), torch.no_grad():
        scan = _graph(_Encoder(net, net.scan_features), torch.rand(1, len(BANDS_M), side, side))
        picture = _graph(_Encoder(net, net.map_features), torch.rand(1, 3, side, side))
    return {"scan": scan, "map": picture}


def _graph(encoder: _Encoder, example: Tensor) -> bytes:
    # The exporter that traces needs no package beyond torch; it is deprecated, and says so, and it warns of group
    # normalisation's check of its input's size, which does not depend on the values.
    with TemporaryDirectory() as folder, warnings.catch_warnings():
        file = Path(folder) / "graph.onnx"
        warnings.simplefilter("ignore", DeprecationWarning)
        warnings.simplefilter("ignore", torch.jit.TracerWarning)
        torch.onnx.export(
            encoder.eval(),
            (example,),
            file,
            dynamo=False,
            opset_version=_OPSET,
            input_names=["image"],
            output_names=["features"],
            dynamic_axes={
                "image": {0: "batch", 2: "height", 3: "width"},
                "features": {0: "batch", 2: "feature_height", 3: "feature_width"},
            },
        )
        return file.read_bytes()


def export(matcher: object, out: Path, calibration: Sequence[Images] = ()) -> Path:
    """Write an export folder.

    Parameters
    ----------
    matcher
        A `RotMatch`.
    out
        The folder; it is made, and files of an export that is there are replaced.
    calibration
        Images of matches; where there are some, the 8-bit graphs are written too (needs onnx and onnxruntime).

    Returns
    -------
    The folder's export.json.

    Raises
    ------
    SkyfixError
        If the matcher is of another kind, a package is missing, or the folder cannot be written.
    """
    if not isinstance(matcher, RotMatch):
        raise SkyfixError(f"export: expected a RotMatch, got {getattr(matcher, 'name', type(matcher).__name__)}")
    graphs = {"fp32": encoder_graphs(matcher.net)}
    if calibration:
        graphs["int8"] = {
            name: quantised(graph, [images[place][None] for images in calibration])
            for place, (name, graph) in enumerate(graphs["fp32"].items())
        }
    facts: dict[str, Any] = {
        "format": FORMAT,
        "architecture": ARCHITECTURE.tag,
        "settings": asdict(matcher.net.settings),
        "calibration": asdict(matcher.calibration),
        "graphs": {weights: {name: graph_file(name, weights) for name in GRAPHS} for weights in graphs},
    }
    try:
        out.mkdir(parents=True, exist_ok=True)
        for old in (graph_file(name, "int8") for name in GRAPHS):
            (out / old).unlink(missing_ok=True)
        for weights, found in graphs.items():
            for name, graph in found.items():
                (out / graph_file(name, weights)).write_bytes(graph)
        (out / INDEX).write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise SkyfixError(f"export {out}: cannot be written: {error.strerror or error}") from error
    return out / INDEX


def graph_file(name: str, weights: str) -> str:
    """File name of a graph ("scan" or "map") with weights in "fp32" or "int8"."""
    return f"{name}.onnx" if weights == "fp32" else f"{name}.{weights}.onnx"


def quantised(graph: bytes, images: Sequence[NDArray[np.float32]]) -> bytes:
    """Round the convolutions of a graph to 8 bits; activations get the ranges that images (B, C, H, W) give them.

    Raises
    ------
    SkyfixError
        If onnx or onnxruntime is missing.
    """
    try:
        import onnx
        from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static
        from onnxruntime.quantization.shape_inference import quant_pre_process
    except ImportError as error:
        raise SkyfixError(
            f"8-bit export: expected the packages onnx and onnxruntime, got none of the name {error.name}: "
            "pip install 'skyfix[onnxruntime]'"
        ) from error

    class Reader(CalibrationDataReader):
        def __init__(self) -> None:
            self._rest = iter(images)

        def get_next(self) -> dict[str, NDArray[np.float32]] | None:
            image = next(self._rest, None)
            return None if image is None else {"image": image}

    with TemporaryDirectory() as folder, _quiet_logging():
        ready, rounded = Path(folder) / "ready.onnx", Path(folder) / "rounded.onnx"
        quant_pre_process(onnx.load_model_from_string(graph), ready, skip_symbolic_shape=True)
        quantize_static(
            ready,
            rounded,
            Reader(),
            quant_format=QuantFormat.QDQ,
            op_types_to_quantize=["Conv"],
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
        )
        return rounded.read_bytes()


@contextmanager
def _quiet_logging() -> Iterator[None]:
    """The quantiser writes advice to the root logger."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)
