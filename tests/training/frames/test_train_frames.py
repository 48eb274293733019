"""Training frames are the modelled ones, cached while there is room."""

import dataclasses

import pytest
import torch

from thermosplat.datasets.frame_tensors import frame_tensors, with_unit_images
from thermosplat.errors import UserError
from thermosplat.training.frames import train_frames
from thermosplat.training.frames.train_frames import TrainFrames
from toy_run import many_frames, without
from toy_scene import toy_capture

CPU = torch.device("cpu")


def test_frames_without_a_modelled_view_are_left_out() -> None:
    """A model of one spectrum learns from the frames that show it."""
    capture = many_frames(toy_capture())
    first, *rest = capture.train
    capture = dataclasses.replace(capture, train=(without(first, "rgb"), *rest))
    assert len(TrainFrames(capture, ("rgb", "thermal"), CPU)) == 4
    assert len(TrainFrames(capture, ("rgb",), CPU)) == 3
    assert len(TrainFrames(capture, ("thermal",), CPU)) == 4
    only_thermal = dataclasses.replace(capture, train=capture.train[:1])
    with pytest.raises(UserError, match="no training frame of a spectrum that is modelled"):
        TrainFrames(only_thermal, ("rgb",), CPU)


def test_frames_hold_what_is_modelled() -> None:
    """Of three spectra those that are asked for, in the capture's order; nothing is made of the others' images."""
    capture = many_frames(toy_capture(others=("nir", "red"), aligned=False))
    frames = TrainFrames(capture, {"red", "thermal", "rgb"}, CPU)
    assert [list(frame.views) for frame in frames] == [["rgb", "thermal", "red"]] * 4
    assert {frame.shared_cameras for frame in frames} == {(("rgb", "red"), ("thermal",))}
    assert [frame.index.item() for frame in frames] == [0, 1, 2, 3]
    assert list(capture.train[0].views) == ["rgb", "thermal", "nir", "red"]


@pytest.mark.parametrize(("free_bytes", "kept"), [(10**9, 4), (0, 0), (4 * 15_000, 2)])
def test_cache_ends_with_its_budget(monkeypatch: pytest.MonkeyPatch, free_bytes: int, kept: int) -> None:
    """A quarter of the free memory is filled; frames beyond are made anew and are the same."""
    monkeypatch.setattr(train_frames, "free_bytes", lambda device: free_bytes)
    # 24x18 pixels of 3 + 3 bytes and 1 + 1 floats
    frames = TrainFrames(many_frames(toy_capture()), ("rgb", "thermal"), CPU)
    first = [frames.at(place, int, 4) for place in range(4)]
    again = [frames.at(place, int, 4) for place in range(4)]
    assert sum(one is other for one, other in zip(first, again)) == kept
    for one, other in zip(first, again):
        assert all(torch.equal(a, b) for a, b in zip(one.packable(), other.packable(), strict=True))


def test_images_are_kept_as_bytes() -> None:
    """Those of files that hold bytes; in [0, 1] they are what they would be without that, to the bit."""
    capture = many_frames(toy_capture(thermal_kind="scalar"))
    frames = TrainFrames(capture, ("rgb", "thermal"), CPU)
    kept = frames.at(1, int, 4)
    assert {name: view.image.dtype for name, view in kept.views.items()} == {
        "rgb": torch.uint8,
        "thermal": torch.float32,
    }
    expected = frame_tensors(capture.train[1], capture.scales, CPU)
    for found in (frames[1], with_unit_images(kept)):
        assert found.memory is None
        for name, view in expected.views.items():
            assert torch.equal(found.views[name].image, view.image)
        assert torch.equal(found.views["thermal"].intensity, expected.views["thermal"].intensity)
    assert with_unit_images(expected) is expected


def test_free_memory_is_known() -> None:
    """There is some free memory, or nothing would run."""
    assert train_frames.free_bytes(CPU) > 2**20
