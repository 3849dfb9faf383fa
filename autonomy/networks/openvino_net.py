"""A network description compiled by OpenVINO for one CPU thread: the back end for inference.

The model is built operation by operation from the description and numpy arrays, without converter, file or network
access.  It uses one thread, because control shares the computer.  The precision is always set explicitly: by default,
OpenVINO selects bf16 where the processor has matrix tiles.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from functools import cache
from typing import Any, Final

import numpy as np

from autonomy.networks.graph import (
    EPSILON,
    INPUT,
    Add,
    AveragePool,
    BatchNorm,
    Concat,
    Conv,
    MaxPool,
    Network,
    Relu,
    Resize,
    Sigmoid,
    wired,
)
from runtime.errors import InputRefused

PRECISIONS: Final = ("f32", "bf16")
Arrays = Mapping[str, np.ndarray]


class OpenVinoNet:
    """A compiled network for images of one shape.

    Args:
        network: the description.
        arrays: its weights, as ``weights.load`` gives them.
        shape: of the input images, (N, C, H, W).
        precision: "f32", or "bf16" (about three digits; faster where the processor supports it).

    Raises:
        InputRefused: the shape does not fit the network, or the precision is unknown.
    """

    def __init__(
        self, network: Network, arrays: Arrays, shape: tuple[int, int, int, int], precision: str = "f32"
    ) -> None:
        if len(shape) != 4 or shape[1] != network.channels or min(shape) < 1:
            raise InputRefused(
                "network.bad-shape", f"network {network.name} needs images (N, {network.channels}, H, W), not {shape}"
            )
        if precision not in PRECISIONS:
            raise InputRefused("network.bad-precision", f"precision {precision!r} is none of {', '.join(PRECISIONS)}")
        self.network = network
        self.shape = shape
        settings = {
            "INFERENCE_NUM_THREADS": 1,
            "NUM_STREAMS": 1,
            "ENABLE_CPU_PINNING": False,
            "INFERENCE_PRECISION_HINT": precision,
        }
        self._request = _core().compile_model(_model(network, arrays, shape), "CPU", settings).create_infer_request()

    def __call__(self, images: np.ndarray) -> dict[str, np.ndarray]:
        """Every output by name, (N, C, H, W) float32; the caller owns the arrays.

        Raises:
            InputRefused: the images have another shape than the compiled one.
        """
        if images.shape != self.shape:
            raise InputRefused(
                "network.bad-images",
                f"network {self.network.name} was compiled for images {self.shape}, not {images.shape}",
            )
        found = self._request.infer([np.ascontiguousarray(images, np.float32)])
        return {name: found[i] for i, name in enumerate(self.network.outputs)}


def _openvino() -> Any:
    """The package without its telemetry: its tools use their own stub when that module cannot be imported."""
    sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]
    import openvino

    return openvino


@cache
def _core() -> Any:
    """The process's one core.

    Each core makes the thread's alternate signal stack its own and restores the one before when it ends
    (openvinotoolkit/openvino pull request 11894).  Of two cores the second would restore the stack of the first, which
    is unmapped by then, and the next signal would kill the process.
    """
    return _openvino().Core()


def _model(network: Network, arrays: Arrays, shape: tuple[int, int, int, int]) -> Any:
    ov = _openvino()
    ops = ov.opset13
    image = ops.parameter(list(shape), np.float32, INPUT)
    values: dict[str, Any] = {INPUT: image}
    for layer, sources in wired(network):
        values[layer.name] = _node(ops, layer, [values[s] for s in sources], arrays)
    return ov.Model([ops.result(values[name]) for name in network.outputs], [image], network.name)


def _node(ops: Any, layer: Any, inputs: list[Any], arrays: Arrays) -> Any:
    x = inputs[0]
    match layer:
        case Conv():
            return _conv(ops, layer, x, arrays)
        case BatchNorm():
            weight, bias, mean, variance = (
                arrays[f"{layer.name}.{kind}"] for kind in ("weight", "bias", "running_mean", "running_var")
            )
            scale = weight / np.sqrt(variance + EPSILON)
            return ops.add(ops.multiply(x, _per_channel(ops, scale)), _per_channel(ops, bias - mean * scale))
        case Relu():
            return ops.relu(x)
        case Sigmoid():
            return ops.sigmoid(x)
        case MaxPool():
            k = [layer.factor] * 2
            return ops.max_pool(x, k, [1, 1], [0, 0], [0, 0], k).output(0)
        case AveragePool():
            k = [layer.factor] * 2
            return ops.avg_pool(x, k, [0, 0], [0, 0], k, exclude_pad=True)
        case Resize():
            factors = np.array([layer.factor] * 2, np.float32)
            return ops.interpolate(
                x, factors, "linear_onnx", "scales", axes=np.array([2, 3]), coordinate_transformation_mode="half_pixel"
            )
        case Concat():
            return ops.concat(inputs, 1)
        case Add():
            for other in inputs[1:]:
                x = ops.add(x, other)
            return x
        case _:
            raise TypeError(f"no such layer: {layer}")


def _conv(ops: Any, layer: Conv, x: Any, arrays: Arrays) -> Any:
    weight = np.ascontiguousarray(arrays[f"{layer.name}.weight"], np.float32)
    how = ([layer.stride] * 2, [layer.padding] * 2, [layer.padding] * 2, [layer.dilation] * 2)
    if layer.groups == 1:
        y = ops.convolution(x, ops.constant(weight), *how)
    else:
        grouped = weight.reshape(layer.groups, layer.out // layer.groups, *weight.shape[1:])
        y = ops.group_convolution(x, ops.constant(grouped), *how)
    return ops.add(y, _per_channel(ops, arrays[f"{layer.name}.bias"])) if layer.bias else y


def _per_channel(ops: Any, values: np.ndarray) -> Any:
    return ops.constant(np.asarray(values, np.float32).reshape(1, -1, 1, 1))
