"""--lens direct: training on images as they were taken, through a lens that evaluation and later commands have too."""

from pathlib import Path

import pytest
import torch

from rendered_capture import relief_capture, taken_of, trained_on_the_true_scene
from thermosplat.datasets.cameras import LensCoefficients
from thermosplat.datasets.capture import Capture
from thermosplat.datasets.frame_tensors import frame_tensors, packed, packed_elsewhere
from thermosplat.evaluation.held_out import rendered_views
from thermosplat.training.trainer import Trainer
from toy_run import assert_same_state, many_frames, state_tensors, through, toy_run_config, toy_trainer
from toy_scene import toy_capture, toy_config, toy_model

BARREL = LensCoefficients("pinhole", (-0.25, 0.05, 0.0, 0.0, 0.0, 0.0), (0.01, -0.01))
CORNER = 0.3
"""r² near the image's corner."""
FISHEYE = LensCoefficients("fisheye", (-0.05, 0.01, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0))


def rendered_behind_lenses() -> tuple[Capture, dict[str, torch.Tensor]]:
    """A capture that shows a known scene through two lenses, and the scene's parameters."""
    capture = through(
        many_frames(toy_capture(thermal_kind="scalar", aligned=False)), {"rgb": FISHEYE, "thermal": BARREL}
    )
    model = toy_model(toy_config(decoder={"hidden_dim": 8}), capture)
    return taken_of(capture, model)


def test_the_true_scene_shows_the_images_through_its_lenses_alone() -> None:
    """Evaluation compares with the images as they are; without the lenses, the same scene does not fit them."""
    capture, scene = rendered_behind_lenses()
    model = toy_model(toy_config(decoder={"hidden_dim": 8}), capture)
    model.load_state_dict(scene)

    def errors(capture: Capture) -> dict[str, float]:
        views = rendered_views(model, capture.test[0], capture.scales, 1)
        return {view.spectrum: float((view.image - view.target).detach().abs().max()) for view in views}

    assert errors(capture) == pytest.approx({"rgb": 0.0, "thermal": 0.0}, abs=1e-6)
    assert min(errors(through(capture, {})).values()) > 1e-3


def test_a_packed_frame_keeps_its_lenses() -> None:
    """They lie in the frame's memory, so that a step that is replayed sees through the lens of its own frame."""
    capture, _ = rendered_behind_lenses()
    frame = packed(frame_tensors(capture.train[0], capture.scales, "cpu"))
    copy = packed_elsewhere(frame)
    assert copy.memory is not None
    copy.memory.zero_()
    assert frame.views["rgb"].lens_model == "fisheye"
    assert frame.views["thermal"].lens_model == "pinhole"
    torch.testing.assert_close(frame.views["thermal"].lens, torch.tensor([*BARREL.radial, *BARREL.tangential]))
    assert not copy.views["thermal"].lens.any()


@pytest.mark.rotating("resumed runs")
def test_a_resumed_run_is_the_same(tmp_path: Path) -> None:
    """Bit for bit; its metrics say which images it was trained on."""
    capture, _ = rendered_behind_lenses()
    config = toy_run_config(8, lens="direct")
    whole = toy_trainer(tmp_path / "whole", config, capture)
    assert whole.train()["lens"] == "direct"
    half = toy_trainer(tmp_path / "half", config, capture)
    while half.step < 4:
        half.train_step()
    half.save()
    resumed = Trainer.resume(config, capture, half.run)
    while resumed.step < 8:
        resumed.train_step()
    again = toy_trainer(tmp_path / "again", config, capture)
    while again.step < 8:
        again.train_step()
    assert_same_state(state_tensors(resumed), state_tensors(again))


@pytest.mark.rotating("long trainings")
def test_a_wrong_lens_of_the_photographs_comes_back(tmp_path: Path) -> None:
    """--refine distortion corrects the lens itself: gradients come from the projection, on the true scene."""
    capture, scene = rendered_behind_lenses()
    disturbed = through(capture, {"rgb": slightly_off(FISHEYE), "thermal": BARREL})
    config = toy_run_config(100, lens="direct", refine=("distortion",), refine_from=0, refine_first=0)
    trainer = trained_on_the_true_scene(
        tmp_path, config, disturbed, scene, cameras_rate=0.1 / capture.train[0].views["rgb"].camera.width
    )
    assert_corrected(trainer, "rgb", FISHEYE)


@pytest.mark.rotating("long trainings")
def test_a_wrong_thermal_lens_comes_back(tmp_path: Path) -> None:
    """It is registered to the true scene through the lens itself."""
    capture, scene = relief_capture(lenses={"rgb": FISHEYE, "thermal": BARREL})
    disturbed = through(capture, {"rgb": FISHEYE, "thermal": slightly_off(BARREL)})
    config = toy_run_config(12, lens="direct", refine=("distortion",), refine_from=0, refine_every=1, refine_first=12)
    trainer = trained_on_the_true_scene(tmp_path, config, disturbed, scene, last_pass=True)
    assert_corrected(trainer, "thermal", BARREL)


def slightly_off(lens: LensCoefficients) -> LensCoefficients:
    k1, k2, *others = lens.radial
    return lens._replace(radial=(k1 + 0.05, k2 - 0.02, *others))


def assert_corrected(trainer: Trainer, spectrum: str, true: LensCoefficients) -> None:
    """Near the image's corner, a quarter of what was wrong is left at most."""
    found = trainer.corrected_capture().train[0].views[spectrum].camera
    assert found.distortion is None
    assert found.lens is not None
    bends = [lens.radial[0] + CORNER * lens.radial[1] for lens in (true, slightly_off(true), found.lens)]
    assert bends[2] == pytest.approx(bends[0], abs=0.25 * abs(bends[1] - bends[0]))
