"""A convolutional network as plain data: layers by name, in the order in which they run.

A layer reads the layer before it unless it names a ``source`` (``INPUT`` is the network's input).  Tensors are NCHW
float32.  Every convolution pads with zeros so that its output has the input's size divided by the stride ("same").
``torch_net`` and ``openvino_net`` run such a description with the same result; ``weights`` ties a file to it.

The fingerprint of a network depends on the names of layers, layer classes and their fields: renaming one of them
invalidates all weight files.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from typing import Final

from runtime.errors import InputRefused

INPUT: Final = "input"
STATISTICS: Final = ("running_mean", "running_var")
EPSILON: Final = 1e-5
"""Added to the variance in every batch normalisation."""


@dataclass(frozen=True, slots=True)
class Conv:
    """A convolution to ``out`` channels; ``kernel`` is odd."""

    name: str
    out: int
    kernel: int
    stride: int = 1
    dilation: int = 1
    groups: int = 1
    bias: bool = True
    source: str = ""

    @property
    def padding(self) -> int:
        """Zeros on every side [px]."""
        return self.dilation * (self.kernel - 1) // 2


@dataclass(frozen=True, slots=True)
class BatchNorm:
    """Batch normalisation; at inference one scale and one shift per channel."""

    name: str
    source: str = ""


@dataclass(frozen=True, slots=True)
class Relu:
    """max(x, 0)."""

    name: str
    source: str = ""


@dataclass(frozen=True, slots=True)
class Sigmoid:
    """1 / (1 + exp(-x))."""

    name: str
    source: str = ""


@dataclass(frozen=True, slots=True)
class MaxPool:
    """Maximum of every ``factor`` x ``factor`` block; an incomplete block at the far border is dropped."""

    name: str
    factor: int
    source: str = ""


@dataclass(frozen=True, slots=True)
class AveragePool:
    """Mean of every ``factor`` x ``factor`` block; an incomplete block at the far border is dropped."""

    name: str
    factor: int
    source: str = ""


@dataclass(frozen=True, slots=True)
class Resize:
    """Bilinear upsampling by an integer ``factor``; pixel areas correspond (corners not aligned), borders repeat."""

    name: str
    factor: int
    source: str = ""


@dataclass(frozen=True, slots=True)
class Concat:
    """Concatenation of the channels of all sources."""

    name: str
    sources: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Add:
    """The sum of the sources."""

    name: str
    sources: tuple[str, ...]


Layer = Conv | BatchNorm | Relu | Sigmoid | MaxPool | AveragePool | Resize | Concat | Add


@dataclass(frozen=True, slots=True)
class Network:
    """A named network: input channels, layers, and the names of the layers that are outputs.

    Raises:
        InputRefused: two layers have one name, a source does not come before its reader, a kernel is even, channels do
            not fit, or an output is not a layer.
    """

    name: str
    channels: int
    layers: tuple[Layer, ...]
    outputs: tuple[str, ...]

    def __post_init__(self) -> None:
        widths = channels(self)
        for name in self.outputs:
            if name not in widths:
                raise InputRefused("network.unknown-output", f"network {self.name}: output {name!r} is not a layer")


def wired(network: Network) -> list[tuple[Layer, tuple[str, ...]]]:
    """Every layer with the names of its sources."""
    found: list[tuple[Layer, tuple[str, ...]]] = []
    before = INPUT
    for layer in network.layers:
        found.append((layer, layer.sources if isinstance(layer, Concat | Add) else (layer.source or before,)))
        before = layer.name
    return found


def channels(network: Network) -> dict[str, int]:
    """Channels of the input and of every layer's output.

    Raises:
        InputRefused: as ``Network``.
    """
    widths = {INPUT: network.channels}
    for layer, sources in wired(network):
        where = f"network {network.name}, layer {layer.name!r}"
        if layer.name in widths or "." in layer.name or not layer.name:
            raise InputRefused("network.bad-name", f"{where}: its name must be unique, not empty and without a dot")
        if unknown := [s for s in sources if s not in widths]:
            raise InputRefused("network.unknown-source", f"{where}: source {unknown[0]!r} does not come before it")
        width = [widths[s] for s in sources]
        if isinstance(layer, Conv):
            if layer.kernel % 2 == 0:
                raise InputRefused("network.even-kernel", f"{where}: kernel {layer.kernel} is even; use an odd kernel")
            if width[0] % layer.groups or layer.out % layer.groups:
                raise InputRefused(
                    "network.bad-groups",
                    f"{where}: {layer.groups} groups do not divide {width[0]} and {layer.out} channels",
                )
            widths[layer.name] = layer.out
        elif isinstance(layer, Concat):
            widths[layer.name] = sum(width)
        elif isinstance(layer, Add) and len(set(width)) != 1:
            raise InputRefused("network.bad-sum", f"{where}: cannot add sources with {width} channels")
        else:
            widths[layer.name] = width[0]
    return widths


def parameter_shapes(network: Network) -> dict[str, tuple[int, ...]]:
    """Shape of every stored array by name, ``LAYER.weight`` and so on; statistics of batch norms included."""
    widths = channels(network)
    shapes: dict[str, tuple[int, ...]] = {}
    for layer, sources in wired(network):
        if isinstance(layer, Conv):
            shapes[f"{layer.name}.weight"] = (
                layer.out,
                widths[sources[0]] // layer.groups,
                layer.kernel,
                layer.kernel,
            )
            if layer.bias:
                shapes[f"{layer.name}.bias"] = (layer.out,)
        elif isinstance(layer, BatchNorm):
            for kind in ("weight", "bias", *STATISTICS):
                shapes[f"{layer.name}.{kind}"] = (widths[layer.name],)
    return shapes


def parameter_count(network: Network) -> int:
    """Number of trained parameters (without the statistics of batch normalisation)."""
    trained = (s for name, s in parameter_shapes(network).items() if not name.endswith(STATISTICS))
    return sum(math.prod(shape) for shape in trained)


def fingerprint(network: Network) -> str:
    """A hash of everything that determines the meaning of the weights; the name is not included."""
    return hashlib.sha256(repr((network.channels, network.layers, network.outputs)).encode()).hexdigest()[:16]
