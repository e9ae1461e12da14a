"""Runtimes for exported networks: ONNX Runtime and OpenVINO, both optional. A session takes arrays and gives arrays.

The number of threads is torch's (`torch.get_num_threads`), so that one setting holds everything to it. On processors
that have bfloat16 units OpenVINO would use them unasked; here "openvino" computes in float32, and "openvino-bf16" says
what it does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from fusion.errors import SkyfixError

FloatArray = NDArray[np.float32]


class Session(Protocol):
    """A network that is ready to run."""

    def run(self, *inputs: FloatArray) -> list[FloatArray]:
        """Outputs of the inputs, both in the order of the graph's."""
        ...


class OnnxRuntimeSession:
    """ONNX Runtime on the CPU."""

    def __init__(self, graph: bytes) -> None:
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = torch.get_num_threads()
        options.inter_op_num_threads = 1
        options.log_severity_level = 3
        self._session: Any = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
        self._names = [node.name for node in self._session.get_inputs()]

    def run(self, *inputs: FloatArray) -> list[FloatArray]:
        """See `Session.run`."""
        return list(self._session.run(None, dict(zip(self._names, inputs, strict=True))))


class OpenVinoSession:
    """OpenVINO on the CPU; `precision` is "f32" or "bf16"."""

    def __init__(self, graph: bytes, precision: str = "f32") -> None:
        import openvino

        core = openvino.Core()
        settings = {"INFERENCE_PRECISION_HINT": precision, "INFERENCE_NUM_THREADS": torch.get_num_threads()}
        self._request: Any = core.compile_model(core.read_model(graph), "CPU", settings).create_infer_request()

    def run(self, *inputs: FloatArray) -> list[FloatArray]:
        """See `Session.run`; the outputs are copies."""
        found = self._request.infer([np.ascontiguousarray(values) for values in inputs])
        return [np.array(found[port], dtype=np.float32) for port in self._request.model_outputs]


@dataclass(frozen=True, slots=True)
class Backend:
    """A runtime in a precision.

    Attributes
    ----------
    name
        As the command line calls it.
    package
        What has to be installed.
    weights
        Which of an export's graphs it runs: "fp32" or "int8".
    open
        Graph -> session.
    """

    name: str
    package: str
    weights: str
    open: Callable[[bytes], Session]

    def session(self, graph: bytes) -> Session:
        """Get a graph ready to run.

        Raises
        ------
        SkyfixError
            If the runtime is not installed or cannot read the graph.
        """
        if not self.installed:
            raise SkyfixError(
                f"backend {self.name}: expected the package {self.package}, got none: "
                f"pip install 'skyfix[{self.package}]'"
            )
        try:
            return self.open(graph)
        except (RuntimeError, ValueError) as error:
            what = " ".join(str(error).split())
            raise SkyfixError(f"backend {self.name}: expected a graph that it can run, got: {what}") from error
        except Exception as error:  # ONNX Runtime's errors derive from Exception alone
            if type(error).__module__.partition(".")[0] != "onnxruntime":
                raise
            what = " ".join(str(error).split())
            raise SkyfixError(f"backend {self.name}: expected a graph that it can run, got: {what}") from error

    @property
    def installed(self) -> bool:
        """Whether the package is there."""
        return find_spec(self.package) is not None


BACKENDS: dict[str, Backend] = {
    backend.name: backend
    for backend in (
        Backend("openvino", "openvino", "fp32", OpenVinoSession),
        Backend("openvino-bf16", "openvino", "fp32", lambda graph: OpenVinoSession(graph, "bf16")),
        Backend("openvino-int8", "openvino", "int8", OpenVinoSession),
        Backend("onnxruntime", "onnxruntime", "fp32", OnnxRuntimeSession),
        Backend("onnxruntime-int8", "onnxruntime", "int8", OnnxRuntimeSession),
    )
}
"""By name."""


def backend_named(name: str) -> Backend:
    """The backend of a name, or SkyfixError with the names there are."""
    if name not in BACKENDS:
        raise SkyfixError(f"backend: expected torch or one of {', '.join(BACKENDS)}, got {name!r}")
    return BACKENDS[name]


def first_installed() -> Backend:
    """The quickest float32 backend that is installed.

    Raises
    ------
    SkyfixError
        If there is none.
    """
    for backend in BACKENDS.values():
        if backend.weights == "fp32" and backend.installed:
            return backend
    raise SkyfixError("backend: expected openvino or onnxruntime, got neither: pip install 'skyfix[openvino]'")
