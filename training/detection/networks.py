"""The networks that find logs, as torch modules: U-net, mask network, box detector, scorers of segments.

The order in which layers are made decides which random weights a seed gives.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Final

import torch
from torch import nn
from torch.nn import functional as F

from autonomy.perception.papers import BOXES, SIDE_COUNT
from autonomy.perception.segmentation.mask_network import FEATURES, KERNEL, KERNEL_STRIDE, MASKS
from autonomy.perception.segmentation.network import CHANNELS, MAPS
from autonomy.perception.segmentation.segment_merging import HIDDEN_UNITS

TRUNK: Final = ((1, 16, 1, 1), (6, 24, 2, 2), (6, 32, 3, 2), (6, 64, 4, 2), (6, 96, 3, 1), (6, 160, 3, 2))
"""MobileNetV2 without its last block: expansion, channels, blocks, stride of the first."""
WIDTHS: Final = {64: 64, 32: 64, 16: 64, 8: 64, 4: 32, 2: 16}
"""Channels of the mask network's pyramid by stride in the picture."""


def block(
    channels: int, out: int, kernel: int = 3, stride: int = 1, dilation: int = 1, groups: int = 1, bend: bool = True
) -> nn.Sequential:
    """Make a convolution without change of the size but by the stride, batch normalisation and, to ``bend``, a ReLU."""
    padding = dilation * (kernel - 1) // 2
    conv = nn.Conv2d(channels, out, kernel, stride, padding, dilation, groups, bias=False)
    return nn.Sequential(conv, nn.BatchNorm2d(out), *([nn.ReLU()] if bend else []))


def doubled(images: torch.Tensor) -> torch.Tensor:
    """Upsample by 2, bilinearly; pixel areas correspond, borders repeat."""
    return F.interpolate(images, scale_factor=2.0, mode="bilinear", align_corners=False)


class UNet(nn.Module):
    """Picture of a variant in CHANNELS in, MAPS at half its resolution out; its sides are multiples of 16."""

    def __init__(self, variant: str) -> None:
        super().__init__()
        self.in2 = block(CHANNELS[variant], 16, stride=2)
        self.at2 = block(16, 16)
        self.in4 = block(16, 32, stride=2)
        self.at4 = block(32, 32)
        self.in8 = block(32, 48, stride=2)
        self.at8 = block(48, 48)
        self.in16 = block(48, 96, stride=2)
        self.at16 = block(96, 96)
        self.more16 = block(96, 96, dilation=2, bend=False)
        # A log may be longer than the picture is wide: its middle depends on distant pixels.
        self.wide16 = block(96, 96, dilation=4)
        self.wider16 = block(96, 96, dilation=8)
        self.to8 = nn.Conv2d(96, 48, 1)
        self.out8 = block(48, 48)
        self.more8 = block(48, 48, bend=False)
        self.to4 = nn.Conv2d(48, 32, 1)
        self.out4 = block(32, 32)
        self.to2 = nn.Conv2d(32, 16, 1)
        self.out2 = block(16, 24)
        self.maps = nn.Conv2d(24, len(MAPS), 1)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Compute maps (N, 8, H / 2, W / 2)."""
        at2 = self.at2(self.in2(images))
        at4 = self.at4(self.in4(at2))
        at8 = self.at8(self.in8(at4))
        deep = self.at16(self.in16(at8))
        deep = self.wider16(self.wide16(self.more16(deep) + deep))
        out8 = self.out8(doubled(self.to8(deep)) + at8)
        out8 = self.more8(out8) + out8
        out4 = self.out4(doubled(self.to4(out8)) + at4)
        maps: torch.Tensor = self.maps(self.out2(doubled(self.to2(out4)) + at2))
        return maps


class BoxNetwork(nn.Module):
    """Colour, about -1..1, in; a logit and four sides at every eighth pixel out."""

    def __init__(self) -> None:
        super().__init__()
        self.in2 = block(BOXES.channels, 16, stride=2)
        self.in4 = block(16, 32, stride=2)
        self.at4 = block(32, 32)
        self.in8 = block(32, 64, stride=2)
        self.at8 = block(64, 64)
        self.in16 = block(64, 96, stride=2)
        self.at16 = block(96, 96)
        self.wide16 = block(96, 96, dilation=2)
        self.wider16 = block(96, 96, dilation=4)
        self.to8 = nn.Conv2d(96, 64, 1)
        self.out8 = block(64, 64)
        self.more8 = block(64, 64)
        self.boxes = nn.Conv2d(64, 1 + SIDE_COUNT, 1)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Compute maps (N, 5, H / 8, W / 8)."""
        at8 = self.at8(self.in8(self.at4(self.in4(self.in2(images)))))
        deep = self.wider16(self.wide16(self.at16(self.in16(at8))))
        boxes: torch.Tensor = self.boxes(self.more8(self.out8(doubled(self.to8(deep)) + at8)))
        return boxes


class TrunkBlock(nn.Module):
    """A block of MobileNetV2: widening, a convolution of each channel, narrowing; the names are torchvision's."""

    def __init__(self, channels: int, out: int, stride: int, expansion: int) -> None:
        super().__init__()
        hidden = expansion * channels
        self.residual = stride == 1 and channels == out
        self.conv = nn.Sequential(
            *([block(channels, hidden, 1)] if expansion > 1 else []),
            block(hidden, hidden, 3, stride, groups=hidden),
            *block(hidden, out, 1, bend=False),
        )

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Compute the block's output."""
        out: torch.Tensor = self.conv(images)
        return out + images if self.residual else out


class MaskNetwork(nn.Module):
    """Picture in, its maps and kernels out (``mask_network``); its sides are multiples of 64.

    ``features``, the trunk, has the names of torchvision's MobileNetV2.  A trunk of half the size does not see details
    at half the picture's resolution: they have layers of their own.
    """

    def __init__(self) -> None:
        super().__init__()
        self.features = nn.Sequential(block(MASKS.channels, 32, stride=2))
        width, stride, widths, self.strides = 32, 4, dict[int, int](), [4]
        for expansion, out, blocks, first in TRUNK:
            for j in range(blocks):
                step = first if j == 0 else 1
                self.features.append(TrunkBlock(width, out, step, expansion))
                width, stride = out, stride * step
                widths[stride] = out
                self.strides.append(stride)
        self.top = block(width, WIDTHS[64], 1)
        self.down, self.side, self.out = nn.ModuleDict(), nn.ModuleDict(), nn.ModuleDict()
        for level in (32, 16, 8, 4):
            self.down[str(level)] = nn.Conv2d(WIDTHS[2 * level], WIDTHS[level], 1)
            self.side[str(level)] = nn.Conv2d(widths[level], WIDTHS[level], 1)
            self.out[str(level)] = block(WIDTHS[level], WIDTHS[level])
        self.middle = nn.Sequential(block(WIDTHS[KERNEL_STRIDE], 64), block(64, 64))
        self.kernels = nn.Conv2d(64, 1 + KERNEL, 1)
        self.down2 = nn.Conv2d(WIDTHS[4], WIDTHS[2], 1)
        self.detail = nn.Sequential(block(MASKS.channels, 16, stride=2), block(16, WIDTHS[2]))
        self.out2 = block(WIDTHS[2], 24)
        self.maps = nn.Conv2d(24, len(MAPS) + FEATURES, 1)

    def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Compute maps (N, 24, H / 2, W / 2) and kernels (N, 23, H / 8, W / 8)."""
        x, taps = F.avg_pool2d(images, 2), dict[int, torch.Tensor]()
        for part, stride in zip(self.features, self.strides, strict=True):
            taps[stride] = x = part(x)
        at = self.top(x)
        for level, down in self.down.items():
            at = self.out[level](doubled(down(at)) + self.side[level](taps[int(level)]))
            if int(level) == KERNEL_STRIDE:
                kernels = self.kernels(self.middle(at))
        return self.maps(self.out2(doubled(self.down2(at)) + self.detail(images))), kernels


def scoring_network(features: int) -> nn.Sequential:
    """Make a network: the features of a segment, or of a pair of them, in, the logit of a probability out: channels of
    a picture."""
    first, logit = nn.Conv2d(features, HIDDEN_UNITS, 1), nn.Conv2d(HIDDEN_UNITS, 1, 1)
    return nn.Sequential(OrderedDict(first=first, bent=nn.ReLU(), logit=logit))
