"""What a run says of a scene that was not learnt, or that training views alone show well."""

import pytest
import torch

from thermosplat.evaluation.training_views import one_color_error, remarks, training_views
from toy_scene import toy_capture, toy_config, toy_model


def test_one_color_is_the_mean_of_all_images() -> None:
    """Of two images, each of one colour, the nearest single colour lies between them."""
    dark, light = torch.zeros(4, 5, 3), torch.full((4, 5, 3), 0.4)
    assert one_color_error([dark, light]) == pytest.approx(0.04)
    assert one_color_error([light]) == pytest.approx(0.0, abs=1e-12)


def test_numbers_of_every_spectrum() -> None:
    """A toy scene has both, and a perfect constant has no more than one colour."""
    capture = toy_capture()
    found = training_views(toy_model(toy_config(), capture), capture, sh_degree=1)
    assert set(found) == {"rgb", "thermal"}
    for name, numbers in found.items():
        targets = [torch.as_tensor(frame.views[name].pixels().image).float() for frame in capture.train]
        targets = [target / 255 if target.max() > 1 else target for target in targets]
        error = one_color_error([target if target.dim() == 3 else target[..., None] for target in targets])
        assert numbers["one_color_psnr"] == pytest.approx(-10 * torch.log10(torch.tensor(error)).item(), abs=0.1)


@pytest.mark.parametrize(
    ("trained", "held_out", "fixed", "said"),
    [
        (30.0, 28.0, False, None),
        (14.0, 13.5, False, "did not learn its RGB images"),
        (28.0, 11.0, True, "17.0 dB below training views (11.0, 28.0)"),
        (28.0, 11.0, True, "--budget auto"),
        (28.0, 11.0, False, "more images help"),
        (28.0, None, False, None),
    ],
)
def test_remarks(trained: float, held_out: float | None, fixed: bool, said: str | None) -> None:
    """Nothing about a good scene; a sentence with the numbers about one that is not, and what can be done."""
    numbers = {"rgb": {"psnr": trained, "one_color_psnr": 12.0}}
    lines = remarks({"training_views": numbers, "rgb": None if held_out is None else {"psnr": held_out}}, fixed)
    assert len(lines) == (0 if said is None else 1)
    assert said is None or said in lines[0]
