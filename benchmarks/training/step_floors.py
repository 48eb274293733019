"""The floor of each part of a training step: bytes over the measured bandwidth, or operations over the measured peak.

The rasterizer's parts are those of measuring/floors.py. The others, in float32, for a Gaussian with F stored numbers
(68 in the method with degree 3), d features, and images of c channels in all spectra:

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

from collections.abc import Mapping
from typing import Any

import torch

from measuring.device_peaks import DevicePeaks
from measuring.floors import stage_floors
from measuring.fragments import Fragments, count_fragments
from thermosplat.datasets.frame_tensors import FrameTensors
from thermosplat.losses.image_terms import image_terms
from thermosplat.scene.model import RenderedFrame, SceneModel
from thermosplat.training.session.run_metrics import feature_channels
from thermosplat.training.trainer import Trainer

FLOOR_FRAMES = 4
"""Frames, spread over the capture, whose floors are averaged."""

ADAM_BYTES = 28
LOSS_BYTES = 20

RENAMED = {"colors": "SH", "colors adjoint": "SH adjoint"}
"""Stages of measuring/floors.py by their name here."""

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
        rendered = trainer.model.render(
            frame.views, sh_degree=trainer.config.sh_degree, shared_cameras=frame.shared_cameras
        )
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
    dim = feature_channels(model)
    has_sh = any(model.formations[name].takes_colors for name in info["spectra"])
    # without features a call renders one spectrum from its SH colours, or two
    first = 3 * len(info["spectra"]) if dim is None else dim + (3 if has_sh else 0)
    second = (dim or 3) if info.get("thermal_opacities") is not None else 0
    floors = stage_floors(
        fragments,
        info["means2d"].shape[-2],
        len(info["flatten_ids"]),
        (info["width"], info["height"]),
        info["tile_width"] * info["tile_height"],
        (first, second),
        peaks,
    )
    return {
        RENAMED.get(stage, stage): (floor["bytes"], floor["operations"])
        for stage, floor in floors.items()
        if has_sh or stage not in RENAMED
    }


def _rest(trainer: Trainer, frame: FrameTensors, rendered: RenderedFrame) -> dict[str, tuple[float, float]]:
    """Bytes and operations of decoders, losses and optimizer in the step of one frame."""
    model, config = trainer.model, trainer.config
    stored = sum(p.numel() for p in model.parameters())
    amounts = {
        "optimizer": (float(ADAM_BYTES * stored), 0.0),
        "image losses": (float(LOSS_BYTES * sum(t.render.numel() for t in image_terms(rendered, frame, config))), 0.0),
    }
    if model.formations.decoder is not None:
        moved = operations = 0.0
        for name, features in rendered.features.items():
            image = rendered.images[name]
            pixels, channels, dim = image.shape[0] * image.shape[1], image.shape[-1], features.shape[-1]
            moved += 4 * pixels * (dim + channels + 2 * channels + 2 * dim)
            operations += 3 * pixels * _weights(model, name)
        amounts["decoders"] = (moved, operations)
    return amounts


@torch.enable_grad()
def _weights(model: SceneModel, spectrum: str) -> int:
    """Multiply-adds a pixel of one spectrum's image: the weights of the decoder's layers that it uses."""
    features = torch.zeros(1, model.config.feature_dim, device=model.background.device)
    decoded = model.formations[spectrum].decoded(features)
    if decoded is None:
        return 0
    weights = [p for name, p in model.formations.named_parameters() if name.endswith("weight")]
    used = torch.autograd.grad(decoded.sum(), weights, allow_unused=True)
    return sum(weight.numel() for weight, gradient in zip(weights, used, strict=True) if gradient is not None)
