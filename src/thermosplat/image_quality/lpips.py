"""LPIPS, the learned perceptual distance of Zhang et al. 2018 (version 0.1), without torchvision.

The linear heads come with the package (lpips_heads/, BSD-2-Clause); the backbone, AlexNet or VGG16 as torchvision names
their parameters, is the user's file or what torchvision left in torch's cache. Without one there is no LPIPS.

Convention: inputs in [0, 1] are rescaled to [-1, 1] first, as the original does for its own inputs and torchmetrics
under ``normalize=True``. ThermalGaussian and MMOne feed [0, 1] unscaled into the VGG version; numbers compare only
between equal backbones and equal scalings, so ``Lpips.name`` states both.
"""

from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn.functional import max_pool2d, relu

from thermosplat.errors import UserError

Net = Literal["alex", "vgg"]

# Convolutions between the layers that are compared, as (index in torchvision's `features`, stride, padding); a max
# pooling of (window, 2) comes before every block but the first where the pools say so.
_BLOCKS: dict[Net, list[list[tuple[int, int, int]]]] = {
    "alex": [[(0, 4, 2)], [(3, 1, 2)], [(6, 1, 1)], [(8, 1, 1)], [(10, 1, 1)]],
    "vgg": [
        [(0, 1, 1), (2, 1, 1)],
        [(5, 1, 1), (7, 1, 1)],
        [(10, 1, 1), (12, 1, 1), (14, 1, 1)],
        [(17, 1, 1), (19, 1, 1), (21, 1, 1)],
        [(24, 1, 1), (26, 1, 1), (28, 1, 1)],
    ],
}
_SHAPES: dict[Net, list[tuple[int, int]]] = {
    "alex": [(64, 11), (192, 5), (384, 3), (256, 3), (256, 3)],
    "vgg": [(n, 3) for n in (64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512)],
}
"""Filters of each convolution and their side [px], as torchvision defines the networks."""
_POOLS: dict[Net, tuple[int | None, ...]] = {"alex": (None, 3, 3, None, None), "vgg": (None, 2, 2, 2, 2)}
_SMALLEST_SIDE: dict[Net, int] = {"alex": 31, "vgg": 16}  # below it the last layers have no pixel left [px]
_CACHE_PATTERNS: tuple[tuple[Net, str], ...] = (("alex", "alexnet-owt-*.pth"), ("vgg", "vgg16-*.pth"))

# ImageNet's mean and standard deviation for inputs in [-1, 1] (LPIPS's ScalingLayer).
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)


class Lpips:
    """Perceptual distance between two images.

    Attributes:
        name: Backbone and input scaling, for the reports: "LPIPS (AlexNet, inputs in [-1, 1])".

    Args:
        backbone: State dict of torchvision's AlexNet or VGG16 (its "features.*" part is enough).
        normalize: Rescale inputs from [0, 1] to [-1, 1]; False feeds them as they are, as ThermalGaussian does.
        device: Where to compute.

    Raises:
        UserError: If the state dict is neither network's.
    """

    def __init__(
        self, backbone: dict[str, Tensor], *, normalize: bool = True, device: torch.device | str = "cpu"
    ) -> None:
        self._net = _which_net(backbone)
        self._normalize = normalize
        self._convolutions = {
            index: tuple(backbone[f"features.{index}.{part}"].to(device, torch.float32) for part in ("weight", "bias"))
            for block in _BLOCKS[self._net]
            for index, _, _ in block
        }
        heads_path = Path(__file__).with_name("lpips_heads") / f"{self._net}.pth"
        heads = torch.load(heads_path, map_location=device, weights_only=True)
        self._heads = [heads[f"lin{layer}.model.1.weight"] for layer in range(5)]
        self._shift = torch.tensor(_SHIFT, device=device)[:, None, None]
        self._scale = torch.tensor(_SCALE, device=device)[:, None, None]
        span = "[-1, 1]" if normalize else "[0, 1]"
        self.name = f"LPIPS ({'AlexNet' if self._net == 'alex' else 'VGG16'}, inputs in {span})"

    @torch.no_grad()
    def __call__(self, render: Tensor, target: Tensor) -> float | None:
        """Distance of a render from the ground truth; 0 for equal images.

        Args:
            render: Rendered image, shape [H, W, C], C = 3 or 1 (repeated to 3); clamped to [0, 1] here.
            target: Ground truth in [0, 1], shape [H, W, C].

        Returns:
            The distance; None for images too small for the backbone (31 px for AlexNet, 16 px for VGG16).
        """
        if min(target.shape[:2]) < _SMALLEST_SIDE[self._net]:
            return None
        distance = torch.zeros((), device=self._shift.device)
        for features, other, head in zip(self._layers(render.clamp(0, 1)), self._layers(target), self._heads):
            difference = (_unit_length(features) - _unit_length(other)).square()
            distance = distance + nn.functional.conv2d(difference, head).mean()
        return distance.item()

    def _layers(self, image: Tensor) -> list[Tensor]:
        """Activations [1, C, h, w] of the five compared layers."""
        x = image.to(self._shift.device).permute(2, 0, 1).expand(3, -1, -1)[None]
        x = ((2 * x - 1 if self._normalize else x) - self._shift) / self._scale
        layers = []
        for block, pool in zip(_BLOCKS[self._net], _POOLS[self._net]):
            if pool is not None:
                x = max_pool2d(x, pool, 2)
            for index, stride, padding in block:
                weight, bias = self._convolutions[index]
                x = relu(nn.functional.conv2d(x, weight, bias, stride, padding))
            layers.append(x)
        return layers


def find_lpips(weights: str | Path | None, device: torch.device | str = "cpu") -> tuple[Lpips | None, str]:
    """LPIPS with the backbone weights at hand.

    Args:
        weights: File with a torchvision state dict, or a folder with alexnet-owt-*.pth or vgg16-*.pth. None: torch's
            cache, where torchvision puts its downloads; AlexNet is preferred, as in torchmetrics.

    Returns:
        The metric and its name, or None and, in one line, why there is none.

    Raises:
        UserError: If ``weights`` is given but holds no such weights.
    """
    folder = Path(torch.hub.get_dir()) / "checkpoints" if weights is None else Path(weights)
    path = folder if weights is not None and folder.is_file() else _first_weights(folder)
    if path is None:
        patterns = " or ".join(pattern for _, pattern in _CACHE_PATTERNS)
        if weights is not None:
            found = f"the folder {folder} has none" if folder.is_dir() else f"{folder} does not exist"
            raise UserError(f"LPIPS needs backbone weights, {patterns}, but {found}.", _WEIGHTS_HINT)
        return None, f"LPIPS skipped: no backbone weights ({patterns}) in {folder}; --lpips-weights names others."
    lpips = Lpips(_load_backbone(path), device=device)
    return lpips, lpips.name


_WEIGHTS_HINT = "Point --lpips-weights to a torchvision state dict of AlexNet or VGG16, or leave it out."


def _first_weights(folder: Path) -> Path | None:
    for _, pattern in _CACHE_PATTERNS:
        for path in sorted(folder.glob(pattern)):
            return path
    return None


def _load_backbone(path: Path) -> dict[str, Tensor]:
    try:
        state: Any = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many kinds for a file that is not its own
        raise UserError(f"{path} cannot be read as PyTorch weights.", _WEIGHTS_HINT) from error
    if not isinstance(state, dict):
        raise UserError(f"{path} holds {type(state).__name__}, not a state dict.", _WEIGHTS_HINT)
    return state


def _which_net(backbone: dict[str, Tensor]) -> Net:
    """The network whose convolutions the state dict has."""
    keys = [key for key in backbone if isinstance(key, str)]
    convolutions = {key for key in keys if key.startswith("features.") and key.endswith(".weight")}
    for net, blocks in _BLOCKS.items():
        if convolutions == {f"features.{index}.weight" for block in blocks for index, _, _ in block}:
            _check_shapes(backbone, net)
            return net
    raise UserError("The LPIPS backbone weights are neither torchvision's AlexNet nor its VGG16.", _WEIGHTS_HINT)


def _check_shapes(backbone: dict[str, Tensor], net: Net) -> None:
    """Refuse weights of a network whose layers have the right names and are others."""
    channels = 3
    layers = zip([index for block in _BLOCKS[net] for index, _, _ in block], _SHAPES[net], strict=True)
    for index, (filters, side) in layers:
        for part, shape in (("weight", (filters, channels, side, side)), ("bias", (filters,))):
            name = f"features.{index}.{part}"
            found = backbone.get(name)
            if not isinstance(found, Tensor):
                what = "no tensor"
            elif found.shape != shape or found.layout != torch.strided or found.device.type == "meta":
                what = f"a tensor of shape {list(found.shape)} ({found.layout}, {found.device.type})"
            elif not found.is_floating_point() or not found.isfinite().all():
                what = "what is no finite number"
            else:
                continue
            raise UserError(
                f"{name} of the LPIPS backbone weights holds {what}; expected are numbers of shape {list(shape)}.",
                _WEIGHTS_HINT,
            )
        channels = filters


def _unit_length(features: Tensor) -> Tensor:
    """Features scaled to unit length over the channels at every pixel."""
    return features / (features.square().sum(dim=1, keepdim=True).sqrt() + 1e-10)
