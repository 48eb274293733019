"""Frames come from other processes in the order of the steps, and what goes wrong there is told in one sentence."""

import os
import re
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from capture_folders import rgb_image, write_image, write_rgbt_scenes
from thermosplat.datasets import load_capture
from thermosplat.datasets.stored_pixels import ImageLostError
from thermosplat.errors import UserError
from thermosplat.training.frames import frame_loader
from thermosplat.training.frames.frame_loader import FrameLoader, num_workers, read_frame

ORDER = [5, 2, 7, 2, 0, 1, 9, 4, 3, 8, 6, 5]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve frames, none held out."""
    return write_rgbt_scenes(tmp_path_factory.mktemp("capture"), 12, folders=False)


@pytest.fixture
def loader(root: Path) -> Iterator[FrameLoader]:
    """One with two processes."""
    found = FrameLoader(load_capture(root, image_memory=1e-9).train, 2, pinned=False)
    yield found
    found.close()


def assert_is(found: frame_loader.ReadFrame, loader: FrameLoader, index: int) -> None:
    expected = read_frame(loader._frames.frames[index], index)
    assert found.place == index
    assert found.views.keys() == expected.views.keys()
    for name, (image, intensity) in expected.views.items():
        assert torch.equal(found.views[name][0], image)
        assert (found.views[name][1] is None) == (intensity is None)
        assert intensity is None or torch.equal(found.views[name][1], intensity)


def test_frames_come_in_the_order_of_the_steps(loader: FrameLoader) -> None:
    """A frame that is asked for twice is read once, and time spent waiting is known."""
    for place, index in enumerate(ORDER):
        found = loader.at(place, ORDER.__getitem__, len(ORDER))
        assert_is(found, loader, index)
        assert loader.at(place, ORDER.__getitem__, len(ORDER)) is found
    assert loader.waited > 0


def test_the_order_may_change_in_the_middle(loader: FrameLoader) -> None:
    """As when withheld frames are trained on: what was read ahead in the old order is read anew."""
    other = ORDER[:3] + ORDER[:2:-1]
    for place in range(3):
        loader.at(place, ORDER.__getitem__, len(ORDER))
    for place in range(3, len(ORDER)):
        assert_is(loader.at(place, other.__getitem__, len(ORDER)), loader, other[place])


def test_all_frames_between_the_steps(loader: FrameLoader) -> None:
    """A budget goes through all of them; the steps go on where they were."""
    assert_is(loader.at(0, ORDER.__getitem__, len(ORDER)), loader, ORDER[0])
    assert [found.place for found in loader.each(range(10))] == list(range(10))
    assert_is(loader.at(1, ORDER.__getitem__, len(ORDER)), loader, ORDER[1])


def test_an_image_that_is_lost_is_named(tmp_path: Path) -> None:
    """The error is the one of this process, without the other one's traceback."""
    root = write_rgbt_scenes(tmp_path, 8, folders=False)
    loader = FrameLoader(load_capture(root, image_memory=1e-9).train, 1, pinned=False)
    write_image(root / "rgb" / "0003.png", rgb_image(3, 64, 48))
    assert loader.at(0, range(7).__getitem__, 7).place == 0
    assert loader.at(1, range(7).__getitem__, 7).place == 1
    with pytest.raises(ImageLostError) as caught:
        loader.at(2, range(7).__getitem__, 7)
    assert caught.value.message == f"{root}/rgb/0003.png is 64x48, and it was 32x24 when the training began."


def test_a_process_that_is_killed(loader: FrameLoader, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is told when the next frame is asked for, not in the middle of something else."""
    monkeypatch.setattr("torch.utils.data._utils.MP_STATUS_CHECK_INTERVAL", 0.2)
    before = signal.getsignal(signal.SIGCHLD)
    loader.at(0, ORDER.__getitem__, 10**6)
    assert signal.getsignal(signal.SIGCHLD) is before
    for process in loader._steps._workers:
        os.kill(process.pid, signal.SIGKILL)
    time.sleep(0.1)
    places = iter(range(1, 10))  # some frames may be ready
    with pytest.raises(ImageLostError, match="was ended by the system, as it does where memory is short") as caught:
        list(map(lambda place: loader.at(place, ORDER.__getitem__, 10**6), places))
    assert "--image-memory" in caught.value.hint


def test_processes_are_as_many_as_memory_allows(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The least is what one of them needs, and the message says how much that is."""
    frames = load_capture(root, image_memory=1e-9).train
    monkeypatch.setattr(frame_loader.os, "sched_getaffinity", lambda _: set(range(64)))
    frame = 32 * 24 * (3 + 7)
    reading = 4 * 32 * 24 * 3 + 40 * 32 * 24
    least = 3 * frame + reading + (reading + 2 * frame)
    assert num_workers(frames, least) == 1
    assert num_workers(frames, least + 2 * (reading + 2 * frame)) == 3
    assert num_workers(frames, 1e9) == frame_loader.MOST_WORKERS
    with pytest.raises(UserError, match="is too little to read one frame") as caught:
        num_workers(frames, least - 1)
    stated = float(re.search(r"([\d.]+) GB are needed at least", caught.value.message)[1])
    assert least <= stated * 1e9 < least + 10**6
