"""Colour changes of training views are learnt beside the scene, which stays as it is without them."""

import dataclasses
from pathlib import Path

import pytest
import torch
from toy_run import assert_same_state, many_frames, state_tensors, toy_run_config, toy_trainer

from thermosplat.rendered_frame import RenderedFrame
from thermosplat.training.exposures import Exposures
from thermosplat.training.trainer import Trainer
from toy_scene import toy_capture


def test_starts_as_identity() -> None:
    """Untrained exposures change nothing."""
    rendered = RenderedFrame(rgb=torch.rand(4, 5, 3), thermal=torch.rand(4, 5, 1), thermal_features=torch.rand(4, 5, 8))
    changed = Exposures(3, 1)(rendered, torch.tensor(1))
    for name in ("rgb", "thermal", "thermal_features"):
        torch.testing.assert_close(getattr(changed, name), getattr(rendered, name))


def test_change_of_a_frame_is_relative_to_all() -> None:
    """A gain that all frames share is the scene's; what one frame has beyond it changes that frame's images."""
    exposures = Exposures(4, 1)
    image, features = torch.rand(4, 5, 1), torch.rand(4, 5, 8)
    with torch.no_grad():
        exposures.thermal[:, 0, 0] = 0.5
    rendered = RenderedFrame(thermal=image, thermal_features=features)
    torch.testing.assert_close(exposures(rendered, torch.tensor(2)).thermal, image)
    with torch.no_grad():
        exposures.thermal[2, 0, 0] += 0.4
        exposures.thermal[2, 0, 1] += 0.04
    changed = exposures(rendered, torch.tensor(2))
    torch.testing.assert_close(changed.thermal, 1.3 * image + 0.03)
    torch.testing.assert_close(changed.thermal_features[..., 3:4], 1.3 * features[..., 3:4] + 0.03)
    assert torch.equal(changed.thermal_features[..., 4:], features[..., 4:])
    torch.testing.assert_close(exposures(rendered, torch.tensor(0)).thermal, 0.9 * image - 0.01)


def test_colors_are_mixed_as_written() -> None:
    """C' = A C + b of every pixel's colours, and of the features that are compared with the same image."""
    exposures = Exposures(2, 3)
    change = torch.randn(3, 4, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        exposures.rgb[0], exposures.thermal[1] = 2.0 * change, 2.0 * change  # the mean of both frames has half of it
    image, features = torch.rand(4, 5, 3), torch.rand(4, 5, 8)
    rendered = RenderedFrame(rgb=image, thermal=image, visible_features=features, thermal_features=features)
    mixed = [
        torch.einsum("ij,hwj->hwi", torch.eye(3) + change[:, :3], x) + change[:, 3] for x in (image, features[..., :3])
    ]
    changed = exposures(rendered, torch.tensor(0))
    torch.testing.assert_close(changed.rgb, mixed[0])
    torch.testing.assert_close(changed.visible_features, torch.cat([mixed[1], features[..., 3:]], dim=-1))
    changed = exposures(rendered, torch.tensor(1))
    torch.testing.assert_close(changed.thermal, mixed[0])
    assert torch.equal(changed.thermal_features, features)  # channel 3 is an intensity, not a colour


@pytest.mark.parametrize("kind", ["color", "scalar"])
def test_training_with_exposures(tmp_path: Path, kind: str) -> None:
    """Exposures learn, survive a checkpoint bit for bit, and are no part of the model."""
    config = toy_run_config(10, model={"exposures": True})
    capture = many_frames(toy_capture(thermal_kind=kind))
    trainer = toy_trainer(tmp_path / "whole", config, capture)
    while trainer.step < 10:
        trainer._train_step()
    assert trainer.state.exposures is not None
    assert trainer.state.exposures.rgb.abs().amax(dim=(1, 2)).min() > 0
    assert trainer.state.exposures.thermal.any()
    assert not any("exposures" in name for name, _ in trainer.model.named_parameters())
    half = toy_trainer(tmp_path / "half", config, capture)
    while half.step < 4:
        half._train_step()
    half._save()
    resumed = Trainer.resume(dataclasses.replace(config), capture, half.run)
    while resumed.step < 10:
        resumed._train_step()
    assert_same_state(state_tensors(resumed), state_tensors(trainer))
