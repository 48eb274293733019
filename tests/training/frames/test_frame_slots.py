"""Where pixels lie in the memory that processes share."""

import mmap
import os
from pathlib import Path

import numpy as np
import pytest
import torch

from capture_folders import HEIGHT, WIDTH, spectra_with, write_image, write_rgbt_scenes
from thermosplat.datasets import load_capture
from thermosplat.training.frames.frame_loader import stored_views
from thermosplat.training.frames.frame_slots import FrameSlots, places_in_slot, slot_bytes


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("source", ["color", "raw"])
def test_pixels_have_their_places(tmp_path: Path, source: str, masked: bool) -> None:
    """Images as they are kept, side by side; what numpy writes torch reads."""
    root = write_rgbt_scenes(tmp_path, folders=False, raw=True)
    if masked:
        for folder in ("rgb", "thermal"):
            write_image(root / "masks" / folder / "0001.png", np.tri(HEIGHT, WIDTH, dtype=np.uint8))
    capture = load_capture(root, image_memory=1e-9, spectra=spectra_with(thermal={"source": source}))
    stored = stored_views(capture.train[0])
    slot = FrameSlots(3, slot_bytes(stored))[1]
    places = places_in_slot(stored)
    for name, place in places.items():
        stored[name].read_into(place.arrays(slot))
    for name, place in places.items():
        found = place.tensors(torch.from_numpy(slot))
        for part, expected in zip(found, stored[name].read_to_train(), strict=True):
            assert (part is None) == (expected is None)
            if part is not None:
                np.testing.assert_array_equal(part.numpy(), expected, strict=True)
        assert (found[2] is None) != masked
    assert [place.is_bytes for place in places.values()] == [True, source == "color"]
    parts = [start for place in places.values() for start in (place.image, place.intensity, place.mask)]
    starts = [start for start in parts if start is not None]
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
    memory = mmap.mmap(-1, 1 << 20)
    monkeypatch.setattr(mmap, "mmap", lambda *_: memory)
    slots, again = FrameSlots(1, 1 << 20), FrameSlots(1, 1 << 20)
    slots.pin(device)  # so that CUDA refuses to pin the same memory again
    again.pin(device)
    assert not again.is_pinned
    assert torch.ones(3, device=device).sum().item() == 3
    slots.unpin()
