"""A handful of Gaussians in front of two small cameras: what tests of the model and the losses look at."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from thermosplat import gaussian_views
from thermosplat.cameras import Camera
from thermosplat.config import DecoderConfig, ModelConfig, TrainConfig
from thermosplat.datasets.capture import Capture, Frame, View
from thermosplat.datasets.frame_tensors import FrameTensors, frame_tensors
from thermosplat.model import RenderedFrame, SceneModel
from thermosplat.radiometry import FLIR_IRON, ThermalScale

WIDTH, HEIGHT = 24, 18


def toy_config(*, decoder: dict[str, Any] | None = None, **model: Any) -> TrainConfig:
    """A small configuration; keyword arguments are those of ModelConfig."""
    return TrainConfig(
        sh_degree=1,
        model=dataclasses.replace(ModelConfig(), **model),
        decoder=dataclasses.replace(DecoderConfig(hidden_dim=16), **(decoder or {})),
    )


def toy_capture(
    *, thermal_kind: str = "color", rgb: bool = True, thermal: bool = True, aligned: bool = True
) -> Capture:
    """One frame of noise images before 60 random points; not aligned: a smaller, shifted thermal camera."""
    rng = np.random.default_rng(0)
    camera = Camera(26.0, 25.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
    viewmat = np.eye(4)
    viewmat[2, 3] = 4.0
    rgb_view = View(
        "rgb", "a", Path("a.png"), camera, viewmat, rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    )
    thermal_camera, thermal_viewmat = camera, viewmat
    if not aligned:
        thermal_camera, thermal_viewmat = camera.resized(16, 14), viewmat.copy()
        thermal_viewmat[0, 3] = 0.2
    intensity = rng.random((thermal_camera.height, thermal_camera.width), dtype=np.float32)
    if thermal_kind == "color":
        image = np.round(FLIR_IRON.to_color(intensity) * 255).astype(np.uint8)
    else:
        image = intensity[..., None]
    thermal_view = View("thermal", "a", Path("t.png"), thermal_camera, thermal_viewmat, image, 10.0 + 20.0 * intensity)
    frame = Frame("a", rgb_view if rgb else None, thermal_view if thermal else None)
    return Capture(
        name="toy",
        root=Path("toy"),
        layout="rgbt-scenes",
        train=(frame,),
        test=(),
        points=rng.normal(scale=0.7, size=(60, 3)).astype(np.float32),
        point_colors=rng.integers(0, 256, (60, 3), dtype=np.uint8),
        thermal_scale=ThermalScale(thermal_kind, FLIR_IRON, (10.0, 30.0)) if thermal else None,
    )


def toy_frame(capture: Capture) -> FrameTensors:
    """The capture's frame on the CPU."""
    return frame_tensors(capture.train[0], capture.thermal_scale, "cpu")


def toy_model(config: TrainConfig, capture: Capture) -> SceneModel:
    """A model in which nothing is at its neutral start any more, so that every switch shows."""
    model = SceneModel.from_capture(config, capture, "cpu")
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if "logit_opacities" in name:
                parameter += 2.0
            elif "decoders" not in name:
                parameter += 0.05 * torch.randn(parameter.shape, generator=generator)
            if "thermal_opacity_offsets" in name:
                parameter += torch.randn(parameter.shape, generator=generator)
    return model


def render(model: SceneModel, frame: FrameTensors, **changes: Any) -> RenderedFrame:
    """A frame's images, of SH degree 1 unless ``changes`` to the arguments of ``SceneModel.render`` say otherwise."""
    arguments = {"rgb": frame.rgb, "thermal": frame.thermal, "sh_degree": 1} | changes
    return model.render(arguments.pop("rgb"), arguments.pop("thermal"), **arguments)


def largest_gradients(model: SceneModel, loss: torch.Tensor) -> dict[str, float]:
    """Largest gradient of every parameter; 0 where there is none."""
    model.zero_grad()
    loss.backward()
    return {name: 0.0 if p.grad is None else p.grad.abs().max().item() for name, p in model.named_parameters()}


def count_calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the rasterization functions in the order in which the model calls them."""
    calls: list[str] = []
    for name in ("rasterization", "rasterization_rgbt"):
        original = getattr(gaussian_views, name)

        def recorded(*args: Any, _original: Any = original, _name: str = name, **kwargs: Any) -> Any:
            calls.append(_name)
            return _original(*args, **kwargs)

        monkeypatch.setattr(gaussian_views, name, recorded)
    return calls
