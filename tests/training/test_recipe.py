"""The limit that MCMC takes from the images."""

from dataclasses import replace

import pytest

from thermosplat.config import TrainConfig
from thermosplat.config.files import load_config
from thermosplat.training.recipe import LEAST, LEAST_OF_NOISY, MOST, with_limit
from toy_scene import toy_capture


def limit(config: TrainConfig, width: int, height: int, *noisy: str) -> int | None:
    """The limit for a capture of which one photograph has this size, and whose images of some spectra are noisy."""
    return limit_and_notes(config, width, height, *noisy)[0]


def limit_and_notes(config: TrainConfig, width: int, height: int, *noisy: str) -> tuple[int | None, tuple[str, ...]]:
    """Likewise, with what the user is told."""
    capture = toy_capture()
    first, *others = capture.train
    view = first.views["rgb"]
    larger = replace(view, camera=view.camera.resized(width, height))
    frames = (replace(first, views={**first.views, "rgb": larger}), *others)
    found, notes = with_limit(config, replace(capture, train=frames), noisy)
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
    """The user is told so."""
    config = replace(load_config("thermosplat_plus"), scenes=1)
    assert limit_and_notes(config, 400, 300) == (LEAST, ())
    most, notes = limit_and_notes(config, 400, 300, "rgb")
    assert most == LEAST_OF_NOISY
    assert notes == ("At most 150,000 Gaussians are made, since RGB images are noisy.",)


def test_noisy_images_have_one_for_each_pixel() -> None:
    """As others have: only what is the least differs."""
    config = replace(load_config("thermosplat_plus"), scenes=1)
    assert limit(config, 500, 400, "rgb", "thermal") == 500 * 400
    assert limit_and_notes(config, 1280, 1024, "rgb") == (1280 * 1024, ())


def test_noise_leaves_a_limit_alone_that_is_given() -> None:
    """It was asked for."""
    made = load_config("thermosplat_plus")
    config = replace(made, densification=replace(made.densification, max_gaussians=300_000))
    assert limit_and_notes(config, 400, 300, "rgb") == (LEAST // 2, ())
