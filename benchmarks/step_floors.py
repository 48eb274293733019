"""The floor of each part of a training step: bytes over the measured bandwidth, or operations over the measured peak.

The rasterizer's parts are those of floors.py. The others, in float32, for a Gaussian with F stored numbers (68 in the
method with degree 3), d features, and images of c channels in all (RGB + thermal):

| part | bytes | multiply-adds |
|---|---|---|
| optimizer | 28 F a Gaussian: gradient, parameter and moments read, the latter three written | |
| decoders | a pixel: forward 4 (2 d + c), backward 4 (4 d + 2 c) | 3 a weight and pixel, float16 on tensor cores |
| image losses | 20 a value: forward render and target, backward both again and the gradient | |

Of the decoders, features are read and images written; then features, images and their gradients are read, and the
features' gradients written. A value of the losses is one channel of a pixel in one of the terms.

The decoders' weights themselves fit a cache. What fused kernels keep between forward and backward is not counted: a
better one computes it again. ``rest`` (sums, copies of the frame) has no floor. Neither have losses on
Gaussians, nor activations, which on CUDA are timed with the projection and on the CPU with the rest.
"""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from device_peaks import DevicePeaks
from floors import stage_floors
from fragments import Fragments, count_fragments

from thermosplat.config import TrainConfig
from thermosplat.datasets.frame_tensors import FrameTensors
from thermosplat.model import RenderedFrame, SceneModel
from thermosplat.training.trainer import Trainer

FLOOR_FRAMES = 4
"""Frames, spread over the capture, whose floors are averaged."""

ADAM_BYTES = 28
LOSS_BYTES = 20

RENAMED = {"colors": "SH", "colors adjoint": "SH adjoint"}
"""Stages of floors.py by their name here."""

Floor = dict[str, Any]


@torch.no_grad()
def step_floors(trainer: Trainer, peaks: DevicePeaks) -> tuple[dict[str, Floor], dict[str, Any]]:
    """Floors of every part of a step, as the mean over some frames.

    Args:
        trainer: Its model and frames.
        peaks: Measured.

    Returns:
        ``bytes``, ``operations``, ``floor_ms`` and ``bound`` by part; and the mean ``pairs`` and ``fragments`` a frame.
    """
    count = len(trainer.frames)
    indices = sorted({count * k // FLOOR_FRAMES for k in range(FLOOR_FRAMES)})
    totals: dict[str, list[float]] = {}
    work = {"pairs": 0.0, "fragments": 0.0}
    for index in indices:
        frame = trainer.frames[index]
        rendered = trainer.model.render(frame.rgb, frame.thermal, sh_degree=trainer.config.sh_degree)
        for info in (info for infos in rendered.infos.values() for info in infos):
            fragments = count_fragments(info, info["width"], info["height"])
            work["pairs"] += len(info["flatten_ids"]) / len(indices)
            work["fragments"] += fragments.either / len(indices)
            for part, amounts in _rasterization(info, fragments, trainer.model, peaks).items():
                _add(totals, part, amounts, len(indices))
        for part, amounts in _rest(trainer, frame, rendered).items():
            _add(totals, part, amounts, len(indices))
    floors: dict[str, Floor] = {}
    for part, (moved, done) in totals.items():
        byte_s = moved / peaks.bytes_per_s
        operation_s = done / (peaks.flops_fp16 / 2 if part == "decoders" else peaks.fma_per_s)
        floors[part] = {
            "bytes": round(moved),
            "operations": round(done),
            "floor_ms": 1e3 * max(byte_s, operation_s),
            "bound": "bytes" if byte_s >= operation_s else "operations",
        }
    return floors, work


def _add(totals: dict[str, list[float]], part: str, amounts: tuple[float, float], frames: int) -> None:
    total = totals.setdefault(part, [0.0, 0.0])
    for k, amount in enumerate(amounts):
        total[k] += amount / frames


def _rasterization(
    info: Mapping[str, Any], fragments: Fragments, model: SceneModel, peaks: DevicePeaks
) -> dict[str, tuple[float, float]]:
    """Bytes and operations of one rasterization, forward and backward."""
    dim = model.config.feature_dim
    sh_of_thermal = 3 if model.config.gaussian_sets == "shared" and dim == 0 else 0
    second = (dim or sh_of_thermal) if info.get("thermal_opacities") is not None else 0
    alone = info.get("modality")
    if alone is None:
        first = 3 + (dim or sh_of_thermal)
    else:
        first = dim if alone == "thermal" and dim else 3 + (dim if alone == "rgb" else 0)
    floors = stage_floors(
        fragments,
        info["means2d"].shape[-2],
        len(info["flatten_ids"]),
        (info["width"], info["height"]),
        info["tile_width"] * info["tile_height"],
        (first, second),
        peaks,
    )
    without_sh = alone == "thermal" and dim > 0
    return {
        RENAMED.get(stage, stage): (floor["bytes"], floor["operations"])
        for stage, floor in floors.items()
        if not (without_sh and stage in RENAMED)
    }


def _rest(trainer: Trainer, frame: FrameTensors, rendered: RenderedFrame) -> dict[str, tuple[float, float]]:
    """Bytes and operations of decoders, losses and optimizer in the step of one frame."""
    model, config = trainer.model, trainer.config
    stored = sum(p.numel() for p in model.parameters())
    amounts = {
        "optimizer": (float(ADAM_BYTES * stored), 0.0),
        "image losses": (float(LOSS_BYTES * _compared(rendered, frame, config)), 0.0),
    }
    if model.decoders is not None:
        moved = operations = 0.0
        for image, features, unused in (
            (rendered.rgb, rendered.visible_features, "thermal_head"),
            (rendered.thermal, rendered.thermal_features, "modulation rgb_head"),
        ):
            if image is None or features is None:
                continue
            pixels, channels, dim = image.shape[0] * image.shape[1], image.shape[-1], features.shape[-1]
            weights = _weights(model.decoders, unused.split())
            moved += 4 * pixels * (dim + channels + 2 * channels + 2 * dim)
            operations += 3 * pixels * weights
        amounts["decoders"] = (moved, operations)
    return amounts


def _weights(decoders: torch.nn.Module, unused: list[str]) -> int:
    """Multiply-adds a pixel of one branch: the weights of the layers that it uses."""
    named = decoders.named_parameters()
    return sum(p.numel() for name, p in named if name.endswith("weight") and name.split(".")[0] not in unused)


def _compared(rendered: RenderedFrame, frame: FrameTensors, config: TrainConfig) -> int:
    """Values (pixels x channels) that image losses compare, over all terms of the frame."""
    loss = config.loss
    terms: list[tuple[float, Callable[[], int]]] = [
        (loss.rgb, lambda: _values(rendered.rgb, frame.rgb, None)),
        (loss.thermal, lambda: _values(rendered.thermal, frame.thermal, None)),
        (loss.features * loss.features_rgb, lambda: _values(rendered.visible_features, frame.rgb, 3)),
        (loss.features * loss.features_thermal, lambda: _values(rendered.thermal_features, frame.thermal, 1)),
    ]
    return sum(count() for weight, count in terms if weight > 0)


def _values(image: torch.Tensor | None, view: object, channels: int | None) -> int:
    """Values of an image that has a target, in all channels or so many."""
    if image is None or view is None:
        return 0
    return image.shape[0] * image.shape[1] * (channels or image.shape[-1])
