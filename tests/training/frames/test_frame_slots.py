"""Where pixels lie in the memory that processes share."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from capture_folders import spectra_with, write_rgbt_scenes
from thermosplat.datasets import load_capture
from thermosplat.training.frames.frame_loader import stored_views
from thermosplat.training.frames.frame_slots import FrameSlots, places_in_slot, slot_bytes


@pytest.mark.parametrize("source", ["color", "raw"])
def test_pixels_have_their_places(tmp_path: Path, source: str) -> None:
    """Images as they are kept, side by side; what numpy writes torch reads."""
    root = write_rgbt_scenes(tmp_path, folders=False, raw=True)
    capture = load_capture(root, image_memory=1e-9, spectra=spectra_with(thermal={"source": source}))
    stored = stored_views(capture.train[0])
    slot = FrameSlots(3, slot_bytes(stored))[1]
    places = places_in_slot(stored)
    for name, place in places.items():
        stored[name].read_into(*place.arrays(slot))
    for name, place in places.items():
        image, intensity = place.tensors(torch.from_numpy(slot))
        expected = stored[name].read_to_train()
        np.testing.assert_array_equal(image.numpy(), expected.image, strict=True)
        if expected.intensity is None:
            assert intensity is None
        else:
            np.testing.assert_array_equal(intensity.numpy(), expected.intensity, strict=True)
    assert [place.is_bytes for place in places.values()] == [True, source == "color"]
    starts = [start for place in places.values() for start in (place.image, place.intensity) if start is not None]
    assert starts == sorted(starts)
    assert all(start % 64 == 0 for start in starts)
    assert max(place.end for place in places.values()) <= len(slot)


def test_another_process_writes_into_them() -> None:
    """What a child writes is there."""
    slots = FrameSlots(2, 64)
    child = os.fork()
    if child == 0:
        slots[1][:] = 7
        os._exit(0)
    os.waitpid(child, 0)
    assert slots[1].tolist() == [7] * 64
    assert slots[0].tolist() == [0] * 64
    assert len(slots) == 2


@pytest.mark.cuda
def test_they_are_pinned_for_copies() -> None:
    """As torch says; what a child writes afterwards is copied; unpinned they are ordinary memory again."""
    device = torch.device("cuda", 0)
    slots = FrameSlots(4, 1 << 20)
    asking, asked = os.pipe()
    child = os.fork()
    if child == 0:
        os.read(asking, 1)
        slots[2][:] = 9
        os._exit(0)
    slots.pin(device)
    assert slots.is_pinned
    pixels = torch.from_numpy(slots[2])
    assert pixels.is_pinned()
    os.write(asked, b"1")
    os.waitpid(child, 0)
    copied = torch.empty_like(pixels, device=device)
    copied.copy_(pixels, non_blocking=True)
    torch.cuda.synchronize()
    assert torch.equal(copied.cpu(), torch.full((1 << 20,), 9, dtype=torch.uint8))
    slots.unpin()
    assert not slots.is_pinned
    assert not pixels.is_pinned()
    slots.unpin()


@pytest.mark.cuda
def test_memory_that_cannot_be_pinned(monkeypatch: pytest.MonkeyPatch) -> None:
    """Copies work as well, and the error is not told to somebody else later."""
    device = torch.device("cuda", 0)
    slots = FrameSlots(1, 1 << 20)
    slots.pin(device)
    again = FrameSlots(1, 1 << 20)
    again._bytes = slots._bytes  # pinned already: CUDA refuses it
    again.pin(device)
    assert not again.is_pinned
    assert torch.ones(3, device=device).sum().item() == 3
    slots.unpin()
