"""ONNX models of the recurrent networks, written without the onnx package.

A protobuf message is a sequence of fields: a key, 8 * number + 2, a length, and the
contents; or 8 * number and a varint.  Field numbers are those of onnx.proto.
"""
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdavis_cv.reconstruct.weights import WIDTH, Weights

INPUTS = ("x", "h1", "h2")
OUTPUTS = ("y", "g1", "g2")

_IR_VERSION, _OPSET = 8, 13
_FLOAT, _INT, _INTS = 1, 2, 7

# The argument of tanh is clipped: OpenCV 5 gives NaN beyond 44; from 16 on it is 1.
_LIMITS = {"least": -16.0, "most": 16.0}


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _number(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _bytes(field: int, value: bytes | str) -> bytes:
    data = value.encode() if isinstance(value, str) else value
    return _varint(field << 3 | 2) + _varint(len(data)) + data


def _attribute(name: str, value: int | Sequence[int]) -> bytes:
    if isinstance(value, int):
        return _bytes(1, name) + _number(3, value) + _number(20, _INT)
    return _bytes(1, name) + b"".join(_number(8, v) for v in value) + _number(20, _INTS)


def _tensor(name: str, array: NDArray[np.float32]) -> bytes:
    return (b"".join(_number(1, side) for side in array.shape) + _number(2, _FLOAT)
            + _bytes(8, name) + _bytes(9, array.astype("<f4").tobytes()))


def _value(name: str, shape: Sequence[int]) -> bytes:
    sides = b"".join(_bytes(1, _number(1, side)) for side in shape)
    return _bytes(1, name) + _bytes(2, _bytes(1, _number(1, _FLOAT) + _bytes(2, sides)))


class _Graph:
    """Nodes and weights of a graph in the order in which they run."""

    def __init__(self) -> None:
        self.nodes: list[bytes] = []
        self.tensors: list[bytes] = []

    def node(self, kind: str, inputs: Sequence[str], outputs: Sequence[str],
             **attributes: int | Sequence[int]) -> str:
        self.nodes.append(
            b"".join(_bytes(1, name) for name in inputs)
            + b"".join(_bytes(2, name) for name in outputs)
            + _bytes(3, outputs[0]) + _bytes(4, kind)
            + b"".join(_bytes(5, _attribute(name, attributes[name]))
                       for name in sorted(attributes)))
        return outputs[0]

    def convolve(self, x: str, name: str, out: str, weight: NDArray[np.float32],
                 bias: NDArray[np.float32] | None) -> str:
        side = weight.shape[-1]
        inputs = [x, f"{name}.weight"]
        self.tensors.append(_tensor(inputs[1], weight))
        if bias is not None:
            inputs.append(f"{name}.bias")
            self.tensors.append(_tensor(inputs[2], bias))
        return self.node("Conv", inputs, [out], kernel_shape=(side, side),
                         pads=(side // 2,) * 4, strides=(1, 1))


def network_onnx(weights: Weights, height: int, width: int) -> bytes:
    """Return the ONNX model (IR 8, operator set 13) of one step of a network.

    Inputs ``x`` (planes of events), ``h1`` and ``h2`` (hidden states), outputs ``y``,
    ``g1`` and ``g2``; shapes are fixed, as OpenCV 4 requires.  Height and width of the
    planes are in macropixels.
    """
    graph, arrays = _Graph(), weights.arrays
    for name, limit in _LIMITS.items():
        graph.tensors.append(_tensor(name, np.array(limit, np.float32)))

    def convolve(x: str, name: str, out: str) -> str:
        return graph.convolve(
            x, name, out, arrays[f"{name}.weight"], arrays[f"{name}.bias"])

    def recurrent(i: int, x: str, state: str, out: str) -> str:
        both = graph.node("Concat", [x, state], [f"g{i}.both"], axis=1)
        gates = graph.node("Sigmoid", [convolve(both, f"g{i}.gates", f"g{i}.sum")],
                           [f"g{i}.gate"])
        z, r = f"g{i}.z", f"g{i}.r"
        graph.node("Split", [gates], [z, r], axis=1)
        reset = graph.node("Mul", [r, state], [f"g{i}.reset"])
        both = graph.node("Concat", [x, reset], [f"g{i}.kept"], axis=1)
        fresh = graph.node("Clip", [convolve(both, f"g{i}.new", f"g{i}.fresh"),
                                    *_LIMITS], [f"g{i}.near"])
        new = graph.node("Tanh", [fresh], [f"g{i}.value"])
        change = graph.node("Sub", [new, state], [f"g{i}.change"])
        part = graph.node("Mul", [z, change], [f"g{i}.part"])
        return graph.node("Add", [state, part], [out])

    def residual(i: int, x: str) -> str:
        y = graph.node("Relu", [convolve(x, f"r{i}.a", f"r{i}.one")], [f"r{i}.two"])
        y = graph.node("Add", [x, convolve(y, f"r{i}.b", f"r{i}.three")],
                       [f"r{i}.four"])
        return graph.node("Relu", [y], [f"r{i}.out"])

    y = graph.node("Relu", [convolve("x", "head", "head.sum")], ["head.out"])
    y = residual(1, recurrent(1, y, "h1", "g1"))
    y = residual(2, recurrent(2, y, "h2", "g2"))
    pred, bias = arrays["pred.weight"], arrays["pred.bias"]
    direct = pred.shape[1] - WIDTH
    inside = np.ascontiguousarray(pred[:, :WIDTH])
    if direct:
        graph.convolve(y, "pred", "pred.inside", inside, bias)
        inputs = arrays["head.weight"].shape[1]
        straight = np.zeros((len(pred), inputs, 1, 1), np.float32)
        straight[:, inputs - direct:] = pred[:, WIDTH:]
        graph.convolve("x", "direct", "pred.direct", straight, None)
        graph.node("Add", ["pred.inside", "pred.direct"], ["y"])
    else:
        graph.convolve(y, "pred", "y", inside, bias)

    planes = {name: _value(name, shape) for name, shape in
              model_shapes(weights, height, width).items()}
    body = (b"".join(_bytes(1, node) for node in graph.nodes)
            + _bytes(2, weights.network)
            + b"".join(_bytes(5, tensor) for tensor in graph.tensors)
            + b"".join(_bytes(11, planes[name]) for name in INPUTS)
            + b"".join(_bytes(12, planes[name]) for name in OUTPUTS))
    return (_number(1, _IR_VERSION) + _bytes(2, "pdavis_cv") + _bytes(7, body)
            + _bytes(8, _bytes(1, "") + _number(2, _OPSET)))


def model_shapes(weights: Weights, height: int, width: int) -> dict[str, Any]:
    """Return the shape of each input and output of `network_onnx`.

    The four channels are a batch for ``firenet``, planes of one image for ``joint``.
    """
    n = 4 if weights.network == "firenet" else 1
    inputs = weights.arrays["head.weight"].shape[1]
    outputs = weights.arrays["pred.weight"].shape[0]
    state = (n, WIDTH, height, width)
    return {"x": (n, inputs, height, width), "h1": state, "h2": state,
            "y": (n, outputs, height, width), "g1": state, "g2": state}
