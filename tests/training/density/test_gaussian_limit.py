"""The limit that MCMC takes from the images."""

from dataclasses import replace
from functools import partial
from typing import Any

import pytest

from thermosplat.config import TrainConfig
from thermosplat.config.files import load_config
from thermosplat.training.density.gaussian_limit import LEAST, LEAST_OF_NOISY, MOST, with_limit
from thermosplat.training.image_noise import ImageNoise
from toy_scene import toy_capture


def noise_of_photographs(plain: float, name: str) -> ImageNoise | None:
    """As training_noise: photographs have this noise, thermal images none that could be measured."""
    return ImageNoise(pixels=2.0 * plain, stripes=0.0, plain=plain) if name == "rgb" else None


def limit(config: TrainConfig, width: int, height: int, noise: float = 0.0) -> int | None:
    """The limit for a capture of which one photograph has this size, and all have this noise."""
    return limit_and_notes(config, width, height, noise)[0]


def limit_and_notes(config: TrainConfig, width: int, height: int, noise: float) -> tuple[int | None, tuple[str, ...]]:
    """Likewise, with what the user is told."""
    capture = toy_capture()
    first, *others = capture.train
    view = first.views["rgb"]
    larger = replace(view, camera=view.camera.resized(width, height))
    frames = (replace(first, views={**first.views, "rgb": larger}), *others)
    found, notes = with_limit(config, replace(capture, train=frames), partial(noise_of_photographs, noise))
    return found.densification.max_gaussians, notes


def test_one_for_each_pixel_of_the_largest_image() -> None:
    """But not fewer than were tried, and not as many as a large photograph has pixels."""
    config = replace(load_config("thermosplat_plus"), scenes=1)
    assert limit(config, 1280, 1024) == 1280 * 1024
    assert limit(config, 64, 48) == LEAST
    assert limit(config, 4000, 3000) == MOST


@pytest.mark.parametrize(("preset", "expected"), [("thermosplat", None), ("thermosplat_fast", 150_000)])
def test_what_has_its_own_limit_or_none_stays(preset: str, expected: int | None) -> None:
    """The default strategy stops by itself, and numbers that are given are kept."""
    assert limit(load_config(preset), 1280, 1024) == expected


@pytest.mark.parametrize("given", [None, 10_001])
def test_each_scene_has_its_part(given: int | None) -> None:
    """So that all together have what one would have."""
    made = load_config("thermosplat_plus")
    config = replace(made, scenes=3, densification=replace(made.densification, max_gaussians=given))
    assert limit(config, 1280, 1024) == (436_907 if given is None else 3334)


def test_fewer_where_photographs_are_noise() -> None:
    """From the noise that the settings name; measured where the scene is plain, since texture is no noise."""
    config = replace(load_config("thermosplat_plus"), scenes=1)
    assert limit_and_notes(config, 400, 300, noise=0.0329) == (LEAST, ())
    most, notes = limit_and_notes(config, 400, 300, noise=0.033)
    assert most == LEAST_OF_NOISY
    assert notes == ("At most 150,000 Gaussians are made, since RGB images are noisy.",)


def test_noisy_images_have_one_for_each_pixel() -> None:
    """As others have: only what is the least differs."""
    config = replace(load_config("thermosplat_plus"), scenes=1)
    assert limit(config, 500, 400, noise=0.1) == 500 * 400
    assert limit_and_notes(config, 1280, 1024, noise=0.1) == (1280 * 1024, ())


@pytest.mark.parametrize(
    "changes",
    [
        {"budget": "fixed"},
        {"auto_budget": replace(load_config("thermosplat_plus").auto_budget, sparse_noise=0.0)},
        {"densification": replace(load_config("thermosplat_plus").densification, max_gaussians=300_000)},
    ],
    ids=["fixed", "never", "given"],
)
def test_noise_leaves_other_limits_alone(changes: dict[str, Any]) -> None:
    """Those of --budget fixed, and any that is given."""
    config = replace(load_config("thermosplat_plus"), **changes)
    assert limit_and_notes(config, 400, 300, noise=0.1) == (LEAST // 2, ())
