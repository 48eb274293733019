"""Colour changes of training views are learnt beside the scene, which stays as it is without them."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from rendered_capture import rendered_capture, trained_on_the_true_scene
from thermosplat.datasets.capture import Frame
from thermosplat.scene.rendered_frame import RenderedFrame
from thermosplat.spectra import DEFAULT_SPECTRA, ColorSpace, Spectrum, SpectrumConfig, model_spectra
from thermosplat.training.exposures import Exposures
from thermosplat.training.trainer import Trainer
from toy_run import assert_same_state, many_frames, state_tensors, toy_run_config, toy_trainer
from toy_scene import toy_capture


def spectra(thermal: ColorSpace, **others: SpectrumConfig) -> tuple[Spectrum, ...]:
    """RGB, thermal of that kind, and further spectra of one value per pixel."""
    kinds: dict[str, ColorSpace] = {"rgb": "photograph", "thermal": thermal}
    return model_spectra(dict(DEFAULT_SPECTRA) | others, kinds | dict.fromkeys(others, "scalar"))


def test_starts_as_identity() -> None:
    """Untrained exposures change nothing."""
    images = {"rgb": torch.rand(4, 5, 3), "thermal": torch.rand(4, 5, 1)}
    rendered = RenderedFrame(images=images, features={"thermal": torch.rand(4, 5, 8)})
    changed = Exposures(3, spectra("scalar"))(rendered, torch.tensor(1))
    torch.testing.assert_close(changed.images, rendered.images)
    torch.testing.assert_close(changed.features, rendered.features)


def test_change_of_a_frame_is_relative_to_all() -> None:
    """A gain that all frames share is the scene's; what one frame has beyond it changes that frame's images."""
    exposures = Exposures(4, spectra("scalar"))
    image, features = torch.rand(4, 5, 1), torch.rand(4, 5, 8)
    with torch.no_grad():
        exposures.maps["thermal"][:, 0, 0] = 0.5
    rendered = RenderedFrame(images={"thermal": image}, features={"thermal": features})
    torch.testing.assert_close(exposures(rendered, torch.tensor(2)).images["thermal"], image)
    with torch.no_grad():
        exposures.maps["thermal"][2, 0, 0] += 0.4
        exposures.maps["thermal"][2, 0, 1] += 0.04
    changed = exposures(rendered, torch.tensor(2))
    torch.testing.assert_close(changed.images["thermal"], 1.3 * image + 0.03)
    torch.testing.assert_close(changed.features["thermal"][..., 3:4], 1.3 * features[..., 3:4] + 0.03)
    assert torch.equal(changed.features["thermal"][..., 4:], features[..., 4:])
    assert torch.equal(changed.features["thermal"][..., :3], features[..., :3])
    torch.testing.assert_close(exposures(rendered, torch.tensor(0)).images["thermal"], 0.9 * image - 0.01)


def test_colors_are_mixed_as_written() -> None:
    """C' = A C + b of every pixel's colours, and of the features that are compared with the same image."""
    exposures = Exposures(2, spectra("color"))
    change = torch.randn(3, 4, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        # the mean of both frames has half of it
        exposures.maps["rgb"][0], exposures.maps["thermal"][1] = 2.0 * change, 2.0 * change
    image, features = torch.rand(4, 5, 3), torch.rand(4, 5, 8)
    both = {"rgb": image, "thermal": image}
    rendered = RenderedFrame(images=both, features={"rgb": features, "thermal": features})
    mixed = [
        torch.einsum("ij,hwj->hwi", torch.eye(3) + change[:, :3], x) + change[:, 3] for x in (image, features[..., :3])
    ]
    changed = exposures(rendered, torch.tensor(0))
    torch.testing.assert_close(changed.images["rgb"], mixed[0])
    torch.testing.assert_close(changed.features["rgb"], torch.cat([mixed[1], features[..., 3:]], dim=-1))
    changed = exposures(rendered, torch.tensor(1))
    torch.testing.assert_close(changed.images["thermal"], mixed[0])
    assert torch.equal(changed.features["thermal"], features)  # channel 3 is an intensity, not a colour


def test_every_spectrum_has_maps_of_its_own() -> None:
    """A third spectrum's gain changes its images and its own latent channel alone; without a channel the image alone.

    Spectra that share a render of features do not share the change.
    """
    features = torch.rand(4, 5, 8)
    images = {"rgb": torch.rand(4, 5, 3), "thermal": torch.rand(4, 5, 3), "nir": torch.rand(4, 5, 1)}
    rendered = RenderedFrame(images=images, features=dict.fromkeys(images, features))
    for supervised in (0.5, None):
        exposures = Exposures(2, spectra("color", nir=SpectrumConfig(features=supervised)))
        assert {name: tuple(maps.shape) for name, maps in exposures.maps.items()} == {
            "rgb": (2, 3, 4),
            "thermal": (2, 3, 4),
            "nir": (2, 1, 2),
        }
        with torch.no_grad():
            exposures.maps["nir"][0, 0] = torch.tensor([0.4, 0.2])
        changed = exposures(rendered, torch.tensor(0))
        for name in ("rgb", "thermal"):
            assert torch.equal(changed.images[name], images[name])
            assert torch.equal(changed.features[name], features)
        torch.testing.assert_close(changed.images["nir"], 1.2 * images["nir"] + 0.1)
        expected = features.clone()
        if supervised is not None:
            expected[..., 4] = 1.2 * features[..., 4] + 0.1
        torch.testing.assert_close(changed.features["nir"], expected)
        assert torch.equal(rendered.features["nir"], features)


def test_a_level_alone() -> None:
    """An uncooled camera's drift: what a frame has beyond the mean of all is added, and nothing is multiplied."""
    exposures = Exposures(2, spectra("scalar")[1:], levels=["thermal"])
    assert exposures.maps["thermal"].shape == (2, 1, 1)
    with torch.no_grad():
        exposures.maps["thermal"][0] = 0.2
    image, features = torch.rand(4, 5, 1), torch.rand(4, 5, 8)
    images = {"rgb": torch.rand(4, 5, 3), "thermal": image}
    rendered = RenderedFrame(images=images, features={"thermal": features})
    for frame, level in ((0, 0.1), (1, -0.1)):
        changed = exposures(rendered, torch.tensor(frame))
        torch.testing.assert_close(changed.images["thermal"], image + level)
        torch.testing.assert_close(changed.features["thermal"][..., 3:4], features[..., 3:4] + level)
        assert changed.images["rgb"] is images["rgb"]


@pytest.mark.rotating("long trainings")
def test_drift_of_a_sensor_is_told_from_the_scene(tmp_path: Path) -> None:
    """On the true scene the levels of a drifting sensor come out; only what asks for exposures has them."""
    capture, scene = rendered_capture()
    drift = (0.06, 0.02, -0.02, -0.06)

    def drifted(frame: Frame, level: float) -> Frame:
        thermal = frame.views["thermal"]
        thermal = dataclasses.replace(thermal, image=thermal.image + np.float32(level))
        return dataclasses.replace(frame, views=frame.views | {"thermal": thermal})

    capture = dataclasses.replace(capture, train=tuple(map(drifted, capture.train, drift)))
    config = toy_run_config(200, spectra={"thermal": {"exposure": "level", "smoothness": 0.0}})
    trainer = trained_on_the_true_scene(tmp_path, config, capture, scene)
    assert trainer.state.exposures is not None
    assert set(trainer.state.exposures.maps) == {"thermal"}
    levels = trainer.state.exposures.maps["thermal"].detach().flatten()
    assert (levels - levels.mean()).tolist() == pytest.approx(drift, abs=0.005)


@pytest.mark.rotating
@pytest.mark.parametrize("kind", ["color", "scalar"])
@pytest.mark.parametrize("others", [(), ("nir",)])
def test_training_with_exposures(tmp_path: Path, kind: str, others: tuple[str, ...]) -> None:
    """Exposures learn, survive a checkpoint bit for bit, and are no part of the model."""
    config = toy_run_config(10, spectra={name: {"exposure": "affine"} for name in ("rgb", "thermal", *others)})
    capture = many_frames(toy_capture(thermal_kind=kind, others=others))
    trainer = toy_trainer(tmp_path / "whole", config, capture)
    while trainer.step < 10:
        trainer.train_step()
    assert trainer.state.exposures is not None
    maps = trainer.state.exposures.maps
    assert set(maps) == {"rgb", "thermal", *others}
    assert maps["rgb"].abs().amax(dim=(1, 2)).min() > 0
    assert all(of_spectrum.any() for of_spectrum in maps.values())
    assert not any("exposures" in name for name, _ in trainer.model.named_parameters())
    half = toy_trainer(tmp_path / "half", config, capture)
    while half.step < 4:
        half.train_step()
    half.save()
    resumed = Trainer.resume(dataclasses.replace(config), capture, half.run)
    while resumed.step < 10:
        resumed.train_step()
    assert_same_state(state_tensors(resumed), state_tensors(trainer))
