"""Smaller images are area averages, seen by cameras as --data-factor makes them, and made once per size."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch

from rolling_captures import shaken
from thermosplat.datasets import load_capture
from thermosplat.datasets.cameras import LensCoefficients
from thermosplat.datasets.frame_tensors import FrameTensors, packed_memory, place_in_frame
from thermosplat.training.frames import train_frames
from thermosplat.training.frames.shrunk_frames import SHORTEST_SIDE, ShrunkFrames, area_averages, shrunk_view
from thermosplat.training.frames.train_frames import TrainFrames
from toy_run import enlarged, many_frames, through
from toy_scene import toy_capture

CPU = torch.device("cpu")
SPECTRA = ("rgb", "thermal")


def frames_of(*, times: int = 3, aligned: bool = True) -> TrainFrames:
    return TrainFrames(enlarged(many_frames(toy_capture(aligned=aligned)), times), SPECTRA, CPU)


def at(sized: ShrunkFrames, place: int, factor: float) -> FrameTensors:
    return sized.at(place, lambda later: later % 4, 100, factor)


@pytest.mark.parametrize(("width", "height"), [(20, 15), (27, 11), (40, 30), (39, 29), (1, 1)])
@pytest.mark.parametrize("channels", [None, 1, 3])
def test_averages_over_the_area_of_a_pixel(width: int, height: int, channels: int | None) -> None:
    """As OpenCV's INTER_AREA, for any ratio."""
    shape = (30, 40) if channels is None else (30, 40, channels)
    pixels = np.random.default_rng(0).random(shape, dtype=np.float32)
    expected = cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA).reshape(height, width, *shape[2:])
    found = area_averages(torch.from_numpy(pixels), width, height)
    torch.testing.assert_close(found, torch.from_numpy(expected), rtol=1e-5, atol=1e-5)
    assert found.is_contiguous()


@pytest.mark.rotating
@pytest.mark.parametrize("factor", [2, 3])
def test_the_images_that_a_data_factor_makes(factor: int) -> None:
    """Cameras are the same to the bit, photographs up to the rounding of a data factor's to 8 bits."""
    sized = ShrunkFrames(TrainFrames(load_capture("sample"), SPECTRA, CPU))
    expected = TrainFrames(load_capture("sample", data_factor=factor), SPECTRA, CPU)
    for index in range(0, len(expected), 8):
        frame = sized.at(index, int, len(expected), factor)
        for name, view in expected[index].views.items():
            found = frame.views[name]
            assert (found.width, found.height) == (view.width, view.height)
            assert torch.equal(found.K, view.K)
            assert torch.equal(found.viewmat, view.viewmat)
        photographs = frame.views["rgb"].image, expected[index].views["rgb"].image
        torch.testing.assert_close(*photographs, rtol=0, atol=0.5001 / 255)


def test_a_pixel_counts_that_covers_counting_ones() -> None:
    """Wholly: the average of what is masked and what is not is of neither."""
    frames = frames_of(times=3)
    frame, taken = frames[0], frames.frames[0]
    mask = torch.ones(frame.views["rgb"].image.shape[:2], dtype=torch.bool)
    mask[:5, :7] = False
    view = shrunk_view(dataclasses.replace(frame.views["rgb"], mask=mask), taken.views["rgb"], 1.7)
    expected = cv2.resize(mask.numpy().astype(np.float64), (view.width, view.height), interpolation=cv2.INTER_AREA)
    assert view.mask is not None
    np.testing.assert_array_equal(view.mask.numpy(), expected > 0.999)


def test_each_spectrum_has_its_own_size_and_a_shortest_side() -> None:
    """A small thermal image is made no smaller than SSIM has use for; spectra of one camera stay of one size."""
    frame = at(ShrunkFrames(frames_of(times=3, aligned=False)), 0, 2.0)
    assert {name: (view.width, view.height) for name, view in frame.views.items()} == {
        "rgb": (43, SHORTEST_SIDE),
        "thermal": (37, SHORTEST_SIDE),
    }
    frame = at(ShrunkFrames(frames_of(times=3)), 0, 1.5)
    assert {(view.width, view.height) for view in frame.views.values()} == {(48, 36)}
    small = at(ShrunkFrames(frames_of(times=1)), 0, 4.0)
    assert {(view.width, view.height) for view in small.views.values()} == {(24, 18)}


def test_frames_are_packed_and_know_their_place() -> None:
    """So captured steps can take them over; what steps do not look at is left out."""
    frame = at(ShrunkFrames(frames_of()), 2, 1.5)
    assert frame.index is not None
    assert frame.index.item() == 2
    assert all(0 <= place_in_frame(frame, tensor) < len(packed_memory(frame)) for tensor in frame.packable())
    assert all(view.values is None for view in frame.views.values())
    assert frame.views["thermal"].intensity is not None


def test_a_lens_stays_what_it_is() -> None:
    """Coefficients of images as they were taken do not depend on their size."""
    lens = LensCoefficients("pinhole", (-0.2, 0.05, 0.0, 0.0, 0.0, 0.0), (0.01, -0.01))
    capture = enlarged(through(many_frames(toy_capture()), {"rgb": lens}), 3)
    frames = TrainFrames(capture, SPECTRA, CPU)
    view = shrunk_view(frames[0].views["rgb"], capture.train[0].views["rgb"], 1.5)
    assert view.lens is not None
    assert torch.equal(view.lens, frames[0].views["rgb"].lens)


def test_images_are_made_once_per_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """A frame seen again is the same one; another size takes the memory of the one before; full size is not copied."""
    monkeypatch.setattr(train_frames, "free_bytes", lambda device: 10**9)
    frames = frames_of()
    sized = ShrunkFrames(frames)
    full = [at(sized, place, 1.0) for place in range(4)]
    left = frames.room
    first = [at(sized, place, 1.5) for place in range(4)]
    assert all(at(sized, place + 4, 1.5) is first[place] for place in range(4))
    assert frames.room < left
    at(sized, 0, 1.2)
    assert at(sized, 0, 1.5) is not first[0]
    assert all(at(sized, place, 1.0) is full[place] for place in range(4))
    assert frames.room == left


def test_without_memory_they_are_made_each_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same images all the same."""
    monkeypatch.setattr(train_frames, "free_bytes", lambda device: 0)
    sized = ShrunkFrames(frames_of())
    first, again = at(sized, 0, 1.5), at(sized, 0, 1.5)
    assert first is not again
    assert torch.equal(packed_memory(first), packed_memory(again))


def test_averages_of_measured_intensities() -> None:
    """Thermal steps compare intensities with the mean of intensities, not with the inverse of a mean colour."""
    capture = enlarged(many_frames(toy_capture()), 3)
    frames = TrainFrames(capture, SPECTRA, CPU)
    view = frames[0].views["thermal"]
    found = shrunk_view(view, capture.train[0].views["thermal"], 1.5)
    assert view.intensity is not None
    assert found.intensity is not None
    torch.testing.assert_close(found.intensity, area_averages(view.intensity, 48, 36))
    torch.testing.assert_close(found.intensity.mean(), view.intensity.mean())


def test_the_whole_image_keeps_its_mean() -> None:
    """Every pixel has the same share, at the borders too."""
    pixels = torch.rand(31, 47, 3, generator=torch.Generator().manual_seed(0))
    averaged = area_averages(pixels, 20, 13)
    torch.testing.assert_close(averaged.mean(dim=(0, 1)), pixels.mean(dim=(0, 1)))
    one_hot = torch.zeros(31, 47)
    one_hot[30, 46] = 1.0
    torch.testing.assert_close(area_averages(one_hot, 20, 13).sum(), torch.tensor(20 * 13 / (31 * 47)))


def test_smaller_images_have_the_times_of_their_lines() -> None:
    """A view whose lines are read one after the other is shrunk as --data-factor shrinks it."""
    capture = shaken(enlarged(many_frames(toy_capture()), 4), ("thermal",))
    frames = TrainFrames(capture, SPECTRA, CPU)
    taken = frames.frames[0].views["thermal"]
    found = shrunk_view(frames[0].views["thermal"], taken, 2.0)
    assert taken.readout is not None
    expected = taken.readout.resized(taken.camera, taken.camera.resized(found.width, found.height))
    torch.testing.assert_close(found.readout, torch.tensor(expected.motion, dtype=torch.float32))
    assert not torch.equal(found.readout, frames[0].views["thermal"].readout)
    assert shrunk_view(frames[0].views["rgb"], frames.frames[0].views["rgb"], 2.0).readout is None
