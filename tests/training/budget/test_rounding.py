"""What float16 shows as well is stored as float16."""

import torch

from thermosplat.scene.packed_parameters import num_bytes, pack
from thermosplat.training.budget.image_change import ImageChange
from thermosplat.training.budget.rounding import round_to_half
from toy_scene import toy_capture, toy_config, toy_frame, toy_model


def test_what_no_image_shows_is_rounded() -> None:
    """All but the means, within the tolerance; half the bytes. A number that float16 lacks, or no tolerance: none."""
    capture = toy_capture()
    model = toy_model(toy_config(), capture)
    gaussians = model.gaussians("shared")
    full = num_bytes(pack(gaussians.state_dict()))
    change = ImageChange(model, [toy_frame(capture)], 1)
    assert round_to_half(model, change, 0.0) == []
    with torch.no_grad():
        gaussians.quats[3] *= 1e6
    means = gaussians.means.detach().clone()
    rounded = round_to_half(model, change, 1e-3)
    names = {name for name, _ in gaussians.named_parameters()}
    assert set(rounded) == {f"shared.{name}" for name in names - {"means", "quats"}}
    assert 0 < change.now() <= 1e-3
    assert torch.equal(gaussians.means, means)
    assert (
        num_bytes(pack(gaussians.state_dict())) == (full + num_bytes({"": gaussians.means, " ": gaussians.quats})) / 2
    )
