"""Frames from the disk are those that are in memory, in any order, on any device."""

import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from capture_folders import rgb_image, spectra_with, write_image, write_rgbt_scenes
from thermosplat.datasets import load_capture
from thermosplat.datasets.frame_tensors import FrameTensors, with_unit_images
from thermosplat.datasets.stored_pixels import ImageLostError
from thermosplat.training.frames.frame_loader import ReadFrame
from thermosplat.training.frames.frames_from_disk import COPIED_AHEAD
from thermosplat.training.frames.train_frames import TrainFrames

COUNT = 22
ORDER = [5, 2, 7, 2, 0, 1, 9, 4, 3, 8, 21, 10, 5, 5, 0]
LITTLE = 0.000_18
"""GB that some of the frames fit into."""


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of 26 frames, four of them held out."""
    return write_rgbt_scenes(tmp_path_factory.mktemp("capture"), 26, folders=False, raw=True)


@pytest.fixture(params=["color", "raw"])
def both(request: pytest.FixtureRequest, root: Path, device: torch.device) -> Iterator[tuple[TrainFrames, TrainFrames]]:
    """Training frames in memory, and on the disk."""
    spectra = spectra_with(thermal={"source": request.param})
    held, read = (load_capture(root, spectra=spectra, image_memory=memory) for memory in (None, LITTLE))
    assert read.on_disk is not None
    frames = TrainFrames(read, ("rgb", "thermal"), device)
    yield TrainFrames(held, ("rgb", "thermal"), device), frames
    frames.close()


def assert_same(found: FrameTensors, expected: FrameTensors) -> None:
    """Images of either may be bytes."""
    found, expected = with_unit_images(found), with_unit_images(expected)
    assert found.name == expected.name
    assert found.shared_cameras == expected.shared_cameras
    assert found.index == expected.index
    for name, view in found.views.items():
        assert torch.equal(view.image, expected.views[name].image)
        assert torch.equal(view.viewmat, expected.views[name].viewmat)
    # on a GPU the inverse of a palette is rounded otherwise than here
    tolerance = 0.0 if found.index.device.type == "cpu" else 1e-5
    torch.testing.assert_close(found.packable(), expected.packable(), rtol=0, atol=tolerance)


def test_in_the_order_of_the_steps(both: tuple[TrainFrames, TrainFrames]) -> None:
    """Asked for again, a frame is the same object: it was not read twice."""
    held, read = both
    order = 4 * ORDER
    for place, index in enumerate(order):
        found = read.at(place, order.__getitem__, len(order))
        assert_same(found, held[index])
        assert read.at(place, order.__getitem__, len(order)) is found


def test_while_the_device_is_late(both: tuple[TrainFrames, TrainFrames], device: torch.device) -> None:
    """Nothing is overwritten that an earlier step has still to read."""
    held, read = both
    expected = [frame.views["rgb"].image.clone() for frame in held]
    sums, wanted = [], []
    ballast = torch.ones((2000, 2000), device=device) if device.type == "cuda" else torch.ones((2, 2))
    order = 4 * ORDER
    for place, index in enumerate(order):
        for _ in range(20):
            ballast = ballast @ ballast * 1e-6  # what a step takes
        found = with_unit_images(read.at(place, order.__getitem__, len(order)))
        sums.append((found.views["rgb"].image * (1 + place)).double().sum() + 0 * ballast[0, 0].double())
        wanted.append((expected[index] * (1 + place)).double().sum())
    assert torch.stack(sums).tolist() == torch.stack(wanted).tolist()


def test_all_of_them_between_the_steps(both: tuple[TrainFrames, TrainFrames]) -> None:
    """And the steps go on; one out of any order disturbs nothing."""
    held, read = both
    for place in range(3):
        read.at(place, ORDER.__getitem__, len(ORDER))
    frames = list(read)
    assert len(frames) == COUNT
    for found, expected in zip(frames, held):
        assert_same(found, expected)
    for place in range(3, len(ORDER)):
        assert_same(read.at(place, ORDER.__getitem__, len(ORDER)), held[ORDER[place]])
        assert_same(read[place % COUNT], held[place % COUNT])


def test_another_order(both: tuple[TrainFrames, TrainFrames]) -> None:
    """From some place on, as where some frames are withheld."""
    held, read = both
    other = ORDER[::-1]
    for place in range(len(ORDER)):
        order = ORDER if place < 6 else other
        assert_same(read.at(place, order.__getitem__, len(ORDER)), held[order[place]])


def test_it_goes_on_after_a_lost_image(root: Path, device: torch.device) -> None:
    """Which is told at its own step; and after it was closed."""
    read = TrainFrames(load_capture(root, image_memory=LITTLE), ("rgb", "thermal"), device)
    held = TrainFrames(load_capture(root), ("rgb", "thermal"), device)
    path = root / "rgb" / "0006.png"
    whole = path.read_bytes()
    try:
        write_image(path, rgb_image(6, 64, 48))
        assert_same(read.at(0, range(COUNT).__getitem__, COUNT), held[0])
        read.close()
        lost = [frame.name for frame in read.frames].index("0006")
        for place in range(lost):
            assert_same(read.at(place, range(COUNT).__getitem__, COUNT), held[place])
        with pytest.raises(ImageLostError, match=r"0006\.png is 64x48"):
            read.at(lost, range(COUNT).__getitem__, COUNT)
    finally:
        path.write_bytes(whole)
    assert_same(read.at(5, range(COUNT).__getitem__, COUNT), held[5])
    read.close()


@pytest.mark.cuda
def test_frames_are_on_the_device_before_their_steps(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where they were read: their bytes lie in the device's slots, and the host's are given back."""
    device = torch.device("cuda", 0)
    read = TrainFrames(load_capture(root, image_memory=LITTLE), ("rgb", "thermal"), device)
    order = 100 * ORDER
    disk = read.from_disk
    assert disk is not None
    at, release = disk.loader.at, disk.loader.release
    copied: list[int] = []
    held: weakref.WeakSet[ReadFrame] = weakref.WeakSet()

    def noted(*arguments: Any) -> ReadFrame:
        frame = at(*arguments)
        assert frame.pixels.is_pinned()
        copied.append(frame.place)
        held.add(frame)
        return frame

    def given_back(frame: ReadFrame) -> None:
        held.discard(frame)
        release(frame)

    monkeypatch.setattr(disk.loader, "at", noted)
    monkeypatch.setattr(disk.loader, "release", given_back)
    for place in range(200):
        read.at(place, order.__getitem__, len(order))
        assert copied == list(range(len(copied)))  # each once
        assert place < len(copied) <= place + 1 + COPIED_AHEAD
        assert len(held) <= COPIED_AHEAD
        torch.cuda.synchronize()
    allocated = torch.cuda.memory_allocated()
    for place in range(200, 400):
        read.at(place, order.__getitem__, len(order))
    assert torch.cuda.memory_allocated() == allocated
    read.close()
    assert not held
