"""Captures of other kinds: feature maps that are like their labels' directions, bands between colours and warmth."""

from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np
import pytest

from scenes.kinds_capture import LABEL_NAMES, capture_with_bands, capture_with_features
from thermosplat.datasets import load_capture

SAMPLE = Path(str(files("thermosplat").joinpath("sample")))


def test_features_tell_labels_through_their_noise(tmp_path: Path) -> None:
    """Pixels of a label have a cosine of 0.96 to their common direction, and of 0 to that of another label."""
    image = np.zeros((80, 80), np.uint8)
    image[:, 40:] = LABEL_NAMES.index("glass")
    labels = tmp_path / "labels" / "train"
    labels.mkdir(parents=True)
    cv2.imwrite(str(labels / "one.png"), image)
    out = capture_with_features(SAMPLE, labels.parent, tmp_path / "capture", 512)
    stack = np.load(out / "maps" / "train" / "one.npy").astype(np.float64)
    assert stack.shape == (20, 20, 512)
    stack /= np.linalg.norm(stack, axis=-1, keepdims=True)
    means = [half.reshape(-1, 512).mean(axis=0) for half in (stack[:, :10], stack[:, 10:])]
    directions = [mean / np.linalg.norm(mean) for mean in means]
    assert (stack[:, :10] @ directions[0]).mean() == pytest.approx(1 / np.sqrt(1.09), abs=0.01)
    assert abs(directions[0] @ directions[1]) < 0.2


def test_few_bands_are_some_of_many(tmp_path: Path) -> None:
    """The first and last of three are those of all, but for noise; every frame has a stack of the photograph's size."""
    three = capture_with_bands(SAMPLE, tmp_path / "three", 9, 3)
    nine = capture_with_bands(SAMPLE, tmp_path / "nine", 9)
    capture = load_capture(SAMPLE)
    stacks = sorted((three / "bands").rglob("*.npy"))
    assert len(stacks) == len(capture.train) + len(capture.test)
    some, everything = (np.load(folder / stacks[0].relative_to(three)) for folder in (three, nine))
    camera = capture.train[0].views["rgb"].camera
    assert some.shape == (camera.height, camera.width, 3)
    np.testing.assert_allclose(some[..., [0, 2]], everything[..., [0, 8]], atol=0.08)
