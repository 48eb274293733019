"""Depths that sweeps find in training images, and what draws a scene to them."""

import dataclasses
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from rendered_capture import relief_capture
from thermosplat.config import ResolutionConfig
from thermosplat.datasets.cameras import LensCoefficients
from thermosplat.datasets.capture import Capture
from thermosplat.scene.rendered_frame import RenderedFrame
from thermosplat.training.frames.train_frames import TrainFrames
from thermosplat.training.swept_depths.swept_depths import SweptDepths
from thermosplat.training.trainer import Trainer
from toy_run import many_frames, through, toy_run_config, toy_trainer, without
from toy_scene import toy_capture

CPU = torch.device("cpu")
SWEPT = {"thermal": {"swept_depth": 0.5}}


def found_of(
    capture: Capture, said: list[str] | None = None, all_can: Callable[[bool], bool] = bool, **changes: Any
) -> SweptDepths:
    """Depths of a capture's thermal training images."""
    frames = TrainFrames(capture, ("rgb", "thermal"), CPU)
    config = toy_run_config(spectra=SWEPT, **changes)
    points, say = torch.from_numpy(capture.points), [].append if said is None else said.append
    return SweptDepths.of(frames, config, points, say, all_can)


def at_log_depth(log_depth: Tensor) -> RenderedFrame:
    """A render whose thermal pixels lie at log-depths [H, W]."""
    alpha = torch.full_like(log_depth, 0.9)[..., None]
    return RenderedFrame(alphas={"thermal": alpha}, log_depths={"thermal": 0.9 * log_depth[..., None]})


def true_depths(capture: Capture, scene: dict[str, Tensor], tmp_path: Path) -> tuple[Trainer, list[Tensor]]:
    """A trainer that has the true scene, and the depths of its thermal training views."""
    config = toy_run_config(spectra=SWEPT)
    trainer = toy_trainer(tmp_path / "true", config, capture)
    trainer.model.load_state_dict(scene)
    with torch.no_grad():
        views = [frame.views["thermal"] for frame in trainer.frames]
        return trainer, [trainer.model.render_depth("thermal", view, expected=True) for view in views]


def test_a_relief_is_found(tmp_path: Path) -> None:
    """Most of each image is known, and there true depths cost little, and depths 5% off the limit of 3%."""
    capture, scene = relief_capture()
    said: list[str] = []
    swept = found_of(capture, said)
    _, depths = true_depths(capture, scene, tmp_path)
    assert said[0] == "Sweeping 4 thermal images for depths."
    assert re.fullmatch(r"They agree on depths in [56]\d% of their pixels\.", said[1])
    for i, depth in enumerate(depths):
        exact, off = (
            swept.losses(at_log_depth(depth.log() + shift), torch.tensor(i))["thermal_swept_depth"].item()
            for shift in (0.0, 0.05)
        )
        assert exact < 0.5 * 0.01
        assert 0.5 * 0.015 < off < 0.5 * 0.03


def test_each_frame_has_its_own(tmp_path: Path) -> None:
    """Frames without the spectrum have no row among those that have it; other sizes have no term."""
    capture, _ = relief_capture(times=2)
    first, *others = capture.train
    capture = dataclasses.replace(capture, train=(*others, dataclasses.replace(first, name="again"), first))
    capture = dataclasses.replace(capture, train=(without(capture.train[0], "thermal"), *capture.train[1:]))
    swept = found_of(capture)
    view = capture.train[1].views["thermal"]
    pixels = torch.zeros(view.camera.height, view.camera.width)
    assert swept.losses(at_log_depth(pixels), torch.tensor(0))["thermal_swept_depth"].item() == 0.0
    assert swept.losses(at_log_depth(pixels), torch.tensor(1))["thermal_swept_depth"].item() > 0.0
    assert swept.losses(at_log_depth(pixels[1:]), torch.tensor(1)) == {}


@pytest.mark.rotating("long trainings")
def test_a_scene_is_drawn_to_them(tmp_path: Path) -> None:
    """A relief that lies 3% too far is drawn back by this loss alone, to a third of that at most."""
    capture, scene = relief_capture()
    trainer, depths = true_depths(capture, scene, tmp_path)
    config = trainer.config
    held = {f.name: 0.0 for f in dataclasses.fields(config.optimizer) if f.name.endswith("_lr")}
    spectra = {
        name: dataclasses.replace(one, loss=1e-9, smoothness=0.0, features=None) for name, one in config.spectra.items()
    }
    config = dataclasses.replace(
        config,
        max_steps=60,
        spectra=spectra,
        optimizer=dataclasses.replace(config.optimizer, **(held | {"means_lr": 1e-2, "means_lr_final": 1e-3})),
        densification=dataclasses.replace(config.densification, stop_step=0),
    )
    run = toy_trainer(tmp_path / "drawn", config, capture)
    run.model.load_state_dict(scene)
    view = run.frames[0].views["thermal"]

    def error() -> float:
        with torch.no_grad():
            return (run.model.render_depth("thermal", view, expected=True) / depths[0] - 1).median().item()

    with torch.no_grad():
        means = run.model.gaussians("shared").means
        R, t = view.viewmat[:3, :3], view.viewmat[:3, 3]
        means.copy_(((means @ R.T + t) * 1.03 - t) @ R)
    assert error() == pytest.approx(0.03, abs=0.005)
    for _ in range(60):
        run.train_step()
    assert abs(error()) < 0.01


def test_they_count_with_images_of_full_size(tmp_path: Path) -> None:
    """They are a loss once images have their full size, swept when they are first asked for, and never twice."""
    config = toy_run_config(max_steps=8, spectra=SWEPT)
    config = dataclasses.replace(config, resolution=ResolutionConfig(factors=(2.0,), until=(0.75,)))
    trainer = toy_trainer(tmp_path, config, many_frames(toy_capture()))
    terms = []
    for _ in range(8):
        trainer.train_step()
        terms.append(trainer.device_step.swept)
    assert terms[:6] == [None] * 6
    assert terms[6] is terms[7] is not None


def test_depths_are_blended_for_what_was_swept_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where nothing could be swept, steps blend no depths for it."""
    config = toy_run_config(max_steps=2, spectra=SWEPT)
    blended: list[bool] = []
    for refine in ((), ("poses",)):
        some = dataclasses.replace(config, refine=refine, loss=dataclasses.replace(config.loss, depth_spread=0.0))
        trainer = toy_trainer(tmp_path / str(len(refine)), some, many_frames(toy_capture()))
        rendered = trainer.model.render

        def render(*args: Any, rendered: Any = rendered, **how: Any) -> RenderedFrame:
            frame = rendered(*args, **how)
            blended.append(bool(frame.log_depths))
            return frame

        monkeypatch.setattr(trainer.model, "render", render)
        trainer.train_step()
    assert blended == [True, False]


def test_what_is_not_swept_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cameras with lenses or that are corrected, and no room, here or on another device: one line says why, and there
    is no such term."""
    capture, _ = relief_capture(times=2)
    view = capture.train[0].views["thermal"]
    pixels = torch.zeros(view.camera.height, view.camera.width)
    said: list[str] = []

    def nothing_is_found(capture: Capture, **changes: Any) -> None:
        assert found_of(capture, said, **changes).losses(at_log_depth(pixels), torch.tensor(0)) == {}

    nothing_is_found(
        through(capture, {"thermal": LensCoefficients("pinhole", (0.1, 0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0))})
    )
    nothing_is_found(capture, refine=("poses",))
    nothing_is_found(capture, all_can=lambda can: not can)
    monkeypatch.setattr(TrainFrames, "reserve", lambda self, size: False)
    nothing_is_found(capture)
    start = "Depths of thermal images are not swept: "
    assert said == [
        f"{start}more than 3 views of pinhole cameras are needed, found 0.",
        f"{start}cameras are corrected while training.",
        f"{start}another device has no memory left for them.",
        f"{start}there is no memory left for them.",
    ]


def test_unknown_pixels_are_nan() -> None:
    """What a sweep does not know is not drawn anywhere: a target of NaN has no term."""
    swept = SweptDepths(
        {"thermal": 1.0},
        {("thermal", (2, 3)): torch.full((1, 2, 3), math.nan)},
        {("thermal", (2, 3)): torch.tensor([0])},
    )
    loss = swept.losses(at_log_depth(torch.zeros(2, 3)), torch.tensor(0))["thermal_swept_depth"]
    assert loss.item() == 0.0
