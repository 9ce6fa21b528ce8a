"""Needle net for the probability of the shaft and the intensity of ends."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from pathlib import Path

import onnx
import torch
from onnx import numpy_helper
from torch import nn
from torch.nn import functional

NEEDLE_WEIGHT = 4.0
"""Additional weight of a needle pixel, because most pixels show the floor."""
LOG_INTENSITY = (-16.0, 3.0)
"""Bounds of the logarithm of the intensity of ends [1/px^2]."""
_HALF, _QUARTER, _FINE = 16, 32, 8  # number of channels at half, quarter and full size
_DILATIONS = (1, 2, 4, 8, 4, 1)
_FIRST_LOG_INTENSITY = -9.5  # initial value of a new net, about one end per patch


def normalized_layer(*shape: int) -> nn.Sequential:
    """Return a convolution with batch normalization, for training.

    Without it, the activations grow ten- to a hundredfold, and half of the channels vanish.
    `folded` removes it.
    """
    return nn.Sequential(nn.Conv2d(*shape, bias=False), nn.BatchNorm2d(shape[1]))


class NeedleNet(nn.Module):
    """Net with a trunk at quarter size and a large receptive field, and two heads at full size.

    Parameters
    ----------
    layer : callable
        Returns a layer: `normalized_layer` to train a new net, a plain convolution to run it.
        Layers at full size are always plain, because normalization would double the duration.
    """

    def __init__(self, layer: Callable[..., nn.Module] = nn.Conv2d) -> None:
        super().__init__()
        self.first = nn.Conv2d(2, _HALF, 5, 2, 2)
        self.second = layer(_HALF, _QUARTER, 3, 2, 1)
        self.trunk = nn.ModuleList(
            layer(_QUARTER, _QUARTER, 3, 1, dilation, dilation) for dilation in _DILATIONS
        )
        self.up_middle = layer(_QUARTER, 4 * _HALF, 1)
        self.middle = layer(_HALF, _HALF, 3, 1, 1)
        self.up_full = nn.Conv2d(_HALF, 4 * _FINE, 1)
        self.fine = nn.Conv2d(2, _FINE, 3, 1, 1)
        self.last = nn.Conv2d(2 * _FINE, _FINE, 3, 1, 1)
        self.out = nn.Conv2d(_FINE, 2, 3, 1, 1)
        with torch.no_grad():
            self.out.bias.copy_(torch.tensor([-2.0, _FIRST_LOG_INTENSITY]))

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return the two maps for images.

        Parameters
        ----------
        image : Tensor, shape (n, 2, height, width)
            `normalized` images and backgrounds; height and width are multiples of 4.

        Returns
        -------
        Tensor, shape (n, 2, height, width)
            Logit of the shaft, and logarithm of the intensity of ends.
        """
        half = functional.relu(self.first(image))
        features = functional.relu(self.second(half))
        for layer in self.trunk:
            features = features + functional.relu(layer(features))
        half = half + twice_as_large(self.up_middle(features))
        half = half + functional.relu(self.middle(half))
        wide = functional.relu(twice_as_large(self.up_full(half)))
        fine = functional.relu(self.fine(image))
        out: torch.Tensor = self.out(functional.relu(self.last(torch.cat([wide, fine], 1))))
        return out


def twice_as_large(image: torch.Tensor) -> torch.Tensor:
    """Return the pixel shuffle of an image, which has twice its size.

    `pixel_shuffle` itself is slow in OpenCV 5: 70 instead of 52 ms for 384x512 pixels.
    """
    count, channels, height, width = image.shape
    parts = image.reshape(count, channels // 4, 2, 2, height, width).permute(0, 1, 4, 2, 5, 3)
    return parts.reshape(count, channels // 4, 2 * height, 2 * width)


def folded(net: NeedleNet) -> NeedleNet:
    """Return the equivalent net with plain convolutions."""
    plain, trained = NeedleNet(), copy.deepcopy(net).eval()
    for name, layer in plain.named_modules():
        if isinstance(layer, nn.Conv2d):
            part = trained.get_submodule(name)
            if isinstance(part, nn.Sequential):
                part = nn.utils.fuse_conv_bn_eval(part[0], part[1])
            layer.load_state_dict(part.state_dict())
    return plain


class StoredNet(nn.Module):
    """Exported net, with probabilities instead of logits."""

    def __init__(self, net: NeedleNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return probability of the shaft and logarithm of the intensity of ends, (n, 1, h, w)."""
        out = self.net(image)
        # Compensate for the weight in the loss, which multiplies the learned odds of the needle.
        shaft = torch.sigmoid(out[:, :1] - math.log(1.0 + NEEDLE_WEIGHT))
        return shaft, torch.clamp(out[:, 1:], *LOG_INTENSITY)


def export(net: NeedleNet, path: Path) -> None:
    """Write a net as ONNX, atomically.

    Parameters
    ----------
    net : NeedleNet
        The net.
    path : Path
        Output file.
    """
    size = {2: "height", 3: "width"}
    new = path.with_suffix(".new")
    stored = StoredNet(folded(net)).eval()
    torch.onnx.export(
        stored,
        (torch.zeros(1, 2, 64, 64),),
        str(new),
        input_names=["image"],
        output_names=["shaft", "end"],
        dynamic_axes={"image": size, "shaft": size, "end": size},
        opset_version=17,
        dynamo=False,
    )
    onnx.checker.check_model(onnx.load(new))
    new.replace(path)


def load_weights(net: NeedleNet, path: Path) -> None:
    """Load weights that `export` wrote.

    Parameters
    ----------
    net : NeedleNet
        The net.
    path : Path
        ONNX file.
    """
    stored = onnx.load(path).graph.initializer
    weights = {each.name: torch.from_numpy(numpy_helper.to_array(each).copy()) for each in stored}
    StoredNet(net).load_state_dict(weights)
