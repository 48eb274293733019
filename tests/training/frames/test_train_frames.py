"""Training frames are the modelled ones, cached while there is room."""

import dataclasses

import pytest
import torch

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


@pytest.mark.parametrize(("free_bytes", "kept"), [(10**9, 4), (0, 0), (4 * 30_000, 2)])
def test_cache_ends_with_its_budget(monkeypatch: pytest.MonkeyPatch, free_bytes: int, kept: int) -> None:
    """A quarter of the free memory is filled; frames beyond are made anew and are the same."""
    monkeypatch.setattr(train_frames, "_free_bytes", lambda device: free_bytes)
    frames = TrainFrames(many_frames(toy_capture()), ("rgb", "thermal"), CPU)  # 24x18 pixels of 3 + 3 + 1 + 1 floats
    first = [frames[index] for index in range(4)]
    again = [frames[index] for index in range(4)]
    assert sum(one is other for one, other in zip(first, again)) == kept
    for one, other in zip(first, again):
        assert torch.equal(one.views["rgb"].image, other.views["rgb"].image)


def test_free_memory_is_known() -> None:
    """There is some free memory, or nothing would run."""
    assert train_frames._free_bytes(CPU) > 2**20
