"""Spherical harmonics that change no training view are dropped, and only those."""

import dataclasses

import torch

from thermosplat.training.sh_bands import drop_bands, needed_degrees
from toy_scene import toy_capture, toy_config, toy_frame, toy_model


def test_no_training_view_changes_by_more_than_the_tolerance() -> None:
    """Some harmonics go, some stay, and the images stay within the tolerance."""
    capture = toy_capture()
    model = toy_model(dataclasses.replace(toy_config(), sh_degree=3), capture)
    frame = toy_frame(capture)
    gaussians = model.gaussians("shared")
    with torch.no_grad():
        gaussians.shN *= torch.logspace(-2, 1, len(gaussians))[:, None, None]
    before = model.render(frame.rgb, frame.thermal, sh_degree=3)
    full = int((gaussians.shN != 0).sum())
    drop_bands(model, [frame], 3, 0.05)
    after = model.render(frame.rgb, frame.thermal, sh_degree=3)
    assert before.rgb is not None
    assert after.rgb is not None
    assert 0 < int((gaussians.shN != 0).sum()) < 0.8 * full
    assert 0 < (after.rgb - before.rgb).abs().max() <= 0.05


def test_needed_degrees() -> None:
    """Degree by degree: what is zero above is not needed, what is large is; unseen Gaussians need nothing."""
    capture = toy_capture()
    model = toy_model(dataclasses.replace(toy_config(), sh_degree=2), capture)
    gaussians, view = model.gaussians("shared"), toy_frame(capture).rgb
    assert view is not None
    with torch.no_grad():
        gaussians.shN.zero_()
        gaussians.sh0.zero_()
        gaussians.means[:4] = torch.tensor([[0.0, 0.0, 0.0], [0.3, 0.1, 0.0], [0.2, 0.3, 0.0], [0.0, 0.0, -50.0]])
        gaussians.shN[1, :3] = 0.2
        gaussians.shN[2, 3:] = 0.2
        gaussians.shN[3] = 1.0  # behind the camera
    needed = needed_degrees(gaussians, gaussians.sh_coeffs, [view], 2, 0.01)
    assert needed[:4].tolist() == [0, 1, 2, 0]
    assert not needed[4:].any()
