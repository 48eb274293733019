"""Frames come from other processes in the order of the steps, and what goes wrong there is told in one sentence."""

import dataclasses
import os
import re
import signal
import time
from collections.abc import Iterator, Sequence
from multiprocessing.context import ForkProcess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from capture_folders import rgb_image, write_image, write_rgbt_scenes
from forked_processes import run_python
from thermosplat.datasets import load_capture
from thermosplat.datasets.kept_images import forget_images, keep_images
from thermosplat.datasets.stored_pixels import ImageLostError, StoredPixels
from thermosplat.errors import UserError
from thermosplat.training.frames import frame_loader
from thermosplat.training.frames.frame_loader import (
    SPARE_SLOTS,
    FrameLoader,
    ReadFrame,
    SharedMaps,
    num_processes,
    stored_views,
)
from thermosplat.training.frames.frame_slots import FrameSlots, places_in_slot, slot_bytes
from thermosplat.training.frames.reading_processes import ReadingProcesses

ORDER = [5, 2, 7, 2, 0, 1, 9, 4, 3, 8, 6, 5]

Stored = list[dict[str, StoredPixels]]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve frames, none held out."""
    return write_rgbt_scenes(tmp_path_factory.mktemp("capture"), 12, folders=False)


@pytest.fixture
def frames(root: Path) -> Stored:
    """Where their pixels are."""
    return stored(root)


@pytest.fixture
def loader(frames: Stored) -> Iterator[FrameLoader]:
    """One with two processes."""
    found = FrameLoader(frames, 2)
    yield found
    found.close()


def stored(root: Path) -> Stored:
    return [stored_views(frame) for frame in load_capture(root, image_memory=1e-9).train]


def assert_is(found: ReadFrame, frames: Stored, index: int) -> None:
    assert found.index == index
    for name, place in places_in_slot(frames[index]).items():
        image, intensity, _ = place.tensors(found.pixels)
        expected = frames[index][name].read_to_train()
        np.testing.assert_array_equal(image.numpy(), expected.image, strict=True)
        assert (intensity is None) == (expected.intensity is None)
        if intensity is not None:
            np.testing.assert_array_equal(intensity.numpy(), expected.intensity, strict=True)


def go_through(loader: FrameLoader, order: Sequence[int], start: int) -> None:
    """Take the frames of an order from a place on, as steps do."""
    for place in range(start, len(order)):
        loader.release(loader.at(place, order.__getitem__, len(order)))


def test_frames_come_in_the_order_of_the_steps(loader: FrameLoader, frames: Stored) -> None:
    """More of them than there are slots; time spent waiting is known."""
    order = 3 * ORDER
    for place, index in enumerate(order):
        found = loader.at(place, order.__getitem__, len(order))
        assert found.place == place
        assert_is(found, frames, index)
        loader.release(found)
    assert loader.waited > 0


def test_frames_stay_until_they_are_released(loader: FrameLoader, frames: Stored) -> None:
    """So that they can be copied meanwhile; where all slots are held there is none for the next."""
    held = [loader.at(place, ORDER.__getitem__, len(ORDER)) for place in range(2 + SPARE_SLOTS)]
    for found, index in zip(held, ORDER):
        assert_is(found, frames, index)
    with pytest.raises(ValueError, match="All slots are held"):
        loader.at(len(held), ORDER.__getitem__, len(ORDER))


def test_what_is_ready_is_known(loader: FrameLoader, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without waiting: nothing before the first frame was asked for, and nothing of another order."""
    assert not loader.is_ready(0, ORDER.__getitem__)
    loader.release(loader.at(0, ORDER.__getitem__, len(ORDER)))
    until = time.monotonic() + 60
    while not loader.is_ready(1, ORDER.__getitem__):
        assert time.monotonic() < until
        time.sleep(0.001)
    assert not loader.is_ready(1, ORDER[::-1].__getitem__)
    assert not loader.is_ready(2, ORDER.__getitem__)
    answered = ReadingProcesses.answered

    def answered_at_once(reading: ReadingProcesses, *, wait: bool) -> Any:
        assert not wait
        return answered(reading, wait=wait)

    monkeypatch.setattr(ReadingProcesses, "answered", answered_at_once)
    loader.at(1, ORDER.__getitem__, len(ORDER))


def test_the_order_may_change_in_the_middle(loader: FrameLoader, frames: Stored) -> None:
    """As when withheld frames are trained on: what was read ahead in the old order is read anew."""
    other = ORDER[:3] + ORDER[:2:-1]
    for place in range(3):
        loader.release(loader.at(place, ORDER.__getitem__, len(ORDER)))
    for place in range(3, len(ORDER)):
        found = loader.at(place, other.__getitem__, len(ORDER))
        assert_is(found, frames, other[place])
        loader.release(found)
    with pytest.raises(ValueError, match="The order ends before place 12"):
        loader.at(12, other.__getitem__, 12)


def test_all_frames_between_the_steps(loader: FrameLoader, frames: Stored) -> None:
    """A budget goes through all of them; the steps go on where they were. No frame comes twice or is lost."""
    for place in range(4):
        found = loader.at(place, ORDER.__getitem__, len(ORDER))
        assert_is(found, frames, ORDER[place])
        loader.release(found)
        seen = []
        for found in loader.each(range(10)):
            assert_is(found, frames, len(seen))
            seen.append(found.place)
            loader.release(found)
        assert seen == list(range(10))
    some = loader.each(range(10))  # left in the middle
    loader.release(next(some))
    assert_is(loader.at(4, ORDER.__getitem__, len(ORDER)), frames, ORDER[4])


def test_it_begins_again_after_it_was_closed(loader: FrameLoader, frames: Stored) -> None:
    """With other processes; a frame from before is nothing to release."""
    before = loader.at(0, ORDER.__getitem__, len(ORDER))
    loader.close()
    loader.close()
    loader.release(before)
    held = [loader.at(place, ORDER.__getitem__, len(ORDER)) for place in range(1, 1 + loader.processes + SPARE_SLOTS)]
    assert_is(held[0], frames, ORDER[1])
    assert len({frame.slot for frame in held}) == len(held)


def test_kept_frames_are_read_from_the_disk(tmp_path: Path) -> None:
    """The second time their files are not needed."""
    root = write_rgbt_scenes(tmp_path / "capture", 8, folders=False)
    capture = load_capture(root, image_memory=1e-9)
    frames = [stored_views(frame) for frame in capture.train]
    expected = [{name: pixels.read_to_train() for name, pixels in frame.items()} for frame in frames]
    loader = FrameLoader(frames, 2)
    (tmp_path / "run").mkdir()
    loader.release(loader.at(0, range(7).__getitem__, 1))  # the processes began before there was a place to keep
    keep_images(capture, tmp_path / "run")
    for found in loader.each(range(len(frames))):
        loader.release(found)
    for path in root.rglob("*.png"):
        path.unlink()
    for found in loader.each(range(len(frames))):
        for name, place in places_in_slot(frames[found.index]).items():
            image, intensity, _ = place.arrays(found.pixels.numpy())
            np.testing.assert_array_equal(image, expected[found.index][name].image)
            if intensity is not None:
                np.testing.assert_array_equal(intensity, expected[found.index][name].intensity)
        loader.release(found)
    loader.close()
    forget_images(capture)


def test_an_image_that_is_lost_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """When its step comes, by the error of this process, without the other one's traceback; nothing goes on there."""
    root = write_rgbt_scenes(tmp_path, 8, folders=False)
    loader = FrameLoader(stored(root), 1)
    lost, answered = [], ReadingProcesses.answered

    def noted(reading: ReadingProcesses, *, wait: bool) -> Any:
        for slot, error in answered(reading, wait=wait):
            lost.extend([error] if error else [])
            yield slot, error

    monkeypatch.setattr(ReadingProcesses, "answered", noted)
    write_image(root / "rgb" / "0003.png", rgb_image(3, 64, 48))
    for place in range(2):
        found = loader.at(place, range(7).__getitem__, 7)
        assert found.index == place
        loader.release(found)
    until = time.monotonic() + 60
    while not lost:
        assert not loader.is_ready(2, range(7).__getitem__)
        assert time.monotonic() < until
    assert not loader.is_ready(2, range(7).__getitem__)
    with pytest.raises(ImageLostError) as caught:
        loader.at(2, range(7).__getitem__, 7)
    assert caught.value.message == f"{root}/rgb/0003.png is 64x48, and it was 32x24 when the training began."
    assert caught.value.hint == "Restore it."
    assert loader.reading is None
    write_image(root / "rgb" / "0003.png", rgb_image(3, 32, 24))
    assert loader.at(2, range(7).__getitem__, 7).index == 2
    loader.close()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_process_that_is_killed(loader: FrameLoader, number: int) -> None:
    """It is told when a frame is asked for that will not come, not in the middle of something else."""
    before, order = signal.getsignal(signal.SIGCHLD), 100 * ORDER
    loader.release(loader.at(0, order.__getitem__, len(order)))
    assert signal.getsignal(signal.SIGCHLD) is before
    for process in loader.reading.processes:
        os.kill(process.pid, number)
    with pytest.raises(ImageLostError, match="was ended by the system, as it does where memory is short") as caught:
        go_through(loader, order, start=1)  # some frames may be ready
    assert "--image-memory" in caught.value.hint


def test_one_of_two_is_killed(loader: FrameLoader) -> None:
    """The frame in its hands will not come, and nobody waits for it."""
    order = 100 * ORDER
    loader.release(loader.at(0, order.__getitem__, len(order)))
    os.kill(loader.reading.processes[0].pid, signal.SIGKILL)
    with pytest.raises(ImageLostError, match="was ended by the system"):
        go_through(loader, order, start=1)


def test_a_mistake_of_the_program(loader: FrameLoader, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its traceback is that of the process that reads."""

    def wrong(*_: object) -> None:
        raise KeyError("a mistake")

    monkeypatch.setattr(StoredPixels, "read_into", wrong)
    with pytest.raises(RuntimeError, match=r"(?s)A process that reads images failed:.*KeyError: 'a mistake'"):
        loader.at(0, ORDER.__getitem__, len(ORDER))


@pytest.mark.parametrize("begins_after", [0.0, 0.2])
def test_signals_leave_them_alone(frames: Stored, begins_after: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C goes to all processes of a terminal, also to one that was just forked; the one that trains decides."""
    run = ForkProcess.run

    def late(process: ForkProcess) -> None:
        time.sleep(begins_after)
        run(process)

    monkeypatch.setattr(ForkProcess, "run", late)
    reading = ReadingProcesses(frames, FrameSlots(len(ORDER), max(map(slot_bytes, frames))), 2, keep_maps=True)
    for process in reading.processes:
        os.kill(process.pid, signal.SIGINT)
        os.kill(process.pid, signal.SIGHUP)
    for slot, index in enumerate(ORDER):
        reading.ask(slot, index)
    answers: list[tuple[int, ImageLostError | None]] = []
    while len(answers) < len(ORDER):
        answers += reading.answered(wait=True)
    assert sorted(answers) == [(slot, None) for slot in range(len(ORDER))]
    assert all(process.is_alive() for process in reading.processes)
    reading.close()


SCRIPT = """
import os
from thermosplat.datasets import load_capture
from thermosplat.training.frames.frame_loader import FrameLoader, stored_views
loader = FrameLoader([stored_views(frame) for frame in load_capture({root!r}, image_memory=1e-9).train], 2)
other = FrameLoader([stored_views(frame) for frame in load_capture({root!r}, image_memory=1e-9).train], 1)
for one in (loader, other):
    one.release(one.at(0, range(7).__getitem__, 7))
print(*(process.pid for one in (loader, other) for process in one.reading.processes), flush=True)
{end}
"""


@pytest.mark.rotating
@pytest.mark.parametrize("end", ["os.kill(os.getpid(), 9)", "raise KeyError"])
def test_none_is_left_behind(root: Path, end: str) -> None:
    """However the process that trains ends, those that read end, too, and it does not wait for them for long."""
    done = run_python("-c", SCRIPT.format(root=str(root), end=end), seconds=60)
    pids = [int(pid) for pid in done.stdout.split()]
    assert len(pids) == 3, done.stderr
    until = time.monotonic() + 60
    while any(Path(f"/proc/{pid}/cmdline").exists() for pid in pids) and time.monotonic() < until:
        time.sleep(0.05)  # somebody else has to take note of their ends
    assert not any(Path(f"/proc/{pid}").exists() and Path(f"/proc/{pid}/cmdline").read_bytes() for pid in pids)


def test_processes_are_as_many_as_memory_allows(frames: Stored, monkeypatch: pytest.MonkeyPatch) -> None:
    """The least is what one of them needs, and the message says how much that is."""
    monkeypatch.setattr(frame_loader.os, "sched_getaffinity", lambda _: set(range(64)))
    frame = 32 * 24 * (3 + 7)
    assert max(map(slot_bytes, frames)) == frame
    reading = 32 * 24 * (7 + 40)
    least = (SPARE_SLOTS + 1) * frame + reading + (reading + frame)
    assert num_processes(frames, least) == 1
    assert num_processes(frames, least + 2 * (reading + frame)) == 3
    assert num_processes(frames, 1e9) == frame_loader.MOST_PROCESSES
    with pytest.raises(UserError, match="is too little to read one frame") as caught:
        num_processes(frames, least - 1)
    stated = float(re.search(r"([\d.]+) GB are needed at least", caught.value.message)[1])
    assert least <= stated * 1e9 < least + 10**6


@pytest.mark.parametrize("count", [1, 8, 9])
def test_maps_of_lenses_take_memory(frames: Stored, count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of few lenses once, for all processes; of many in each of them."""
    monkeypatch.setattr(frame_loader.os, "sched_getaffinity", lambda _: set(range(64)))
    lens = dataclasses.replace(frames[0]["rgb"].lens, model="SIMPLE_RADIAL", params=(30.0, 16.0, 12.0, 0.01))
    bent = [
        {"rgb": dataclasses.replace(frame["rgb"], lens=dataclasses.replace(lens, params=(30.0 + k % count, 16, 12, 0)))}
        for k, frame in enumerate(frames)
    ]
    maps = SharedMaps.of(bent)
    assert (len(maps.stored), maps.kept) == (count, count <= 8)
    one = 8 * 32 * 24
    frame, reading = 3 * 32 * 24, frames[0]["rgb"].reading_bytes
    kept, each = (SPARE_SLOTS + 1) * frame + reading + min(count, 8) * one, reading + frame + (one if count > 8 else 0)
    assert num_processes(bent, kept + 2 * each) == 2
    assert num_processes(bent, kept + 2 * each - 1) == 1


def test_no_memory_for_frames(loader: FrameLoader, monkeypatch: pytest.MonkeyPatch) -> None:
    """The system refuses it: one sentence, with what to do."""

    def refused(*_: object) -> None:
        raise OSError(12, "Cannot allocate memory")

    monkeypatch.setattr("thermosplat.training.frames.frame_slots.mmap.mmap", refused)
    with pytest.raises(ImageLostError, match=r"no memory for the 7 frames .* \(Cannot allocate memory\)") as caught:
        loader.at(0, ORDER.__getitem__, len(ORDER))
    assert "--image-memory" in caught.value.hint
