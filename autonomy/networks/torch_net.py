"""A network description as a torch module: the back end for training and the reference of the other one.

Only training imports this module; torch is not needed for inference.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import nn
from torch.nn import functional as F

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
    channels,
    parameter_shapes,
    wired,
)


class TorchNet(nn.Module):
    """Runs a ``Network``; its parameters have the names of ``parameter_shapes``."""

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.network = network
        self._wired = wired(network)
        widths = channels(network)
        for layer, sources in self._wired:
            if isinstance(layer, Conv):
                conv = nn.Conv2d(
                    widths[sources[0]],
                    layer.out,
                    layer.kernel,
                    layer.stride,
                    layer.padding,
                    layer.dilation,
                    layer.groups,
                    layer.bias,
                )
                self.add_module(layer.name, conv)
            elif isinstance(layer, BatchNorm):
                self.add_module(layer.name, nn.BatchNorm2d(widths[layer.name], eps=EPSILON))

    def forward(self, images: torch.Tensor) -> dict[str, torch.Tensor]:
        """Every output by name from NCHW images."""
        values = {INPUT: images}
        for layer, sources in self._wired:
            x = values[sources[0]]
            match layer:
                case Conv() | BatchNorm():
                    y = self.get_submodule(layer.name)(x)
                case Relu():
                    y = F.relu(x)
                case MaxPool():
                    y = F.max_pool2d(x, layer.factor)
                case AveragePool():
                    y = F.avg_pool2d(x, layer.factor)
                case Resize():
                    y = F.interpolate(x, scale_factor=layer.factor, mode="bilinear", align_corners=False)
                case Concat():
                    y = torch.cat([values[s] for s in sources], 1)
                case Add():
                    y = x
                    for s in sources[1:]:
                        y = y + values[s]
                case _:
                    y = torch.sigmoid(x)
            values[layer.name] = y
        return {name: values[name] for name in self.network.outputs}

    def arrays(self) -> dict[str, np.ndarray]:
        """Copies of all stored arrays, float32."""
        state = self.state_dict()
        return {name: state[name].detach().float().cpu().numpy().copy() for name in parameter_shapes(self.network)}

    def load(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Load the arrays of ``weights.load`` or ``arrays``."""
        own = self.state_dict()
        for name in parameter_shapes(self.network):
            own[name].copy_(torch.from_numpy(np.ascontiguousarray(arrays[name])))


def random_net(network: Network, seed: int) -> TorchNet:
    """A net with random parameters from a seed; torch's global generator is not affected."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return TorchNet(network)
