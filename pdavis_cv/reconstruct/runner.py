"""Inference of a recurrent network by onnxruntime or OpenCV."""
from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv._opencv import opencv
from pdavis_cv.reconstruct.onnx import INPUTS, OUTPUTS, network_onnx
from pdavis_cv.reconstruct.weights import Weights

BACKENDS = ("onnxruntime", "cv2")
"""Libraries that run a network, the faster one first."""

_SMALL = 4096  # macropixels below which a second thread does not pay

Array = NDArray[np.float32]
Runner = Callable[[Array, Array, Array], tuple[Array, Array, Array]]


def chosen_backend(backend: str = "auto") -> str:
    """Return the library to use; "auto" takes the first of ``BACKENDS`` installed."""
    if backend not in ("auto", *BACKENDS):
        raise ValueError(
            f"backend must be one of auto, {', '.join(BACKENDS)}, got {backend!r}")
    wanted = BACKENDS if backend == "auto" else (backend,)
    for name in wanted:
        if _installed(name):
            return name
    raise ImportError(
        f"networks need {' or '.join(wanted)}: pip install onnxruntime, or an "
        "OpenCV wheel such as opencv-contrib-python-headless")


def _installed(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ValueError:  # sys.modules holds a placeholder without a spec
        return False


def make_runner(weights: Weights, height: int, width: int, backend: str) -> Runner:
    """Return a function that runs one step of a network.

    It maps input planes and both hidden states, (x, h1, h2), to output planes and the
    new states, (y, g1, g2), of the shapes that `model_shapes` gives: float32 arrays, of
    which those returned are new.  Height and width are in macropixels.
    """
    model = network_onnx(weights, height, width)
    if backend == "onnxruntime":
        return _onnxruntime(model, 1 if height * width < _SMALL else 0)
    return _cv2(model)


def _onnxruntime(model: bytes, threads: int) -> Runner:
    # Some builds send telemetry from their import on.
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    runtime: Any = importlib.import_module("onnxruntime")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = threads  # 0 = one per core
    # Threads that spin while they wait starve whatever else runs.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    session = runtime.InferenceSession(
        model, options, providers=["CPUExecutionProvider"])

    def run(x: Array, h1: Array, h2: Array) -> tuple[Array, Array, Array]:
        y, g1, g2 = session.run(list(OUTPUTS), dict(zip(INPUTS, (x, h1, h2),
                                                        strict=True)))
        return y, g1, g2

    return run


def _cv2(model: bytes) -> Runner:
    cv2 = opencv()
    if tuple(map(int, cv2.__version__.split(".")[:2])) < (4, 8):
        # 4.6 cannot read the graph, and 4.7 computes something else.
        raise ImportError("networks need onnxruntime, or OpenCV 4.8 or later, this is "
                          f"{cv2.__version__}: pip install onnxruntime")
    net = cv2.dnn.readNetFromONNX(np.frombuffer(model, np.uint8))

    def run(x: Array, h1: Array, h2: Array) -> tuple[Array, Array, Array]:
        for name, value in zip(INPUTS, (x, h1, h2), strict=True):
            net.setInput(value, name)
        # Copies: forward may return views of buffers that the next call overwrites.
        y, g1, g2 = (np.array(out, np.float32) for out in net.forward(list(OUTPUTS)))
        return y, g1, g2

    return run
