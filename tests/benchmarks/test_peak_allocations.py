"""The moment at which most memory is held, found in notes of allocations as torch writes them."""

import gc
from pathlib import Path
from typing import Any

import pytest
import torch

from measuring.peak_allocations import (
    Allocation,
    held_in,
    lines_of,
    peak_among,
    peak_of,
    peak_table,
    reserved_by_pool,
    start_noting,
    stop_noting,
)

MEGABYTE = 1_000_000


def frame(filename: str, line: int = 1, name: str = "f") -> dict[str, Any]:
    """A line of a stack."""
    return {"filename": filename, "line": line, "name": name}


def event(action: str, address: int, size: int = 0, *frames: dict[str, Any]) -> dict[str, Any]:
    """A note of torch's."""
    return {"action": action, "addr": address, "size": size, "frames": list(frames)}


def test_the_peak_lies_where_most_is_held() -> None:
    """What was there before and was not let go counts; an address that is used again is another tensor."""
    held = {1: Allocation(3 * MEGABYTE, ("a.py:1 f",)), 2: Allocation(MEGABYTE, ("b.py:1 g",))}
    ours = frame("/x/src/thermosplat/c.py", 7, "h")
    events = [
        event("alloc", 3, 2 * MEGABYTE, ours),
        event("free_requested", 2),
        event("free_completed", 2),
        event("alloc", 2, 4 * MEGABYTE, ours),
        event("segment_alloc", 9, 50 * MEGABYTE),
        event("free_requested", 3),
        event("free_requested", 8),
        event("alloc", 3, MEGABYTE, ours),
    ]
    peak = peak_among(events, held)
    assert (peak.bytes, peak.before) == (9 * MEGABYTE, 4 * MEGABYTE)
    assert [size // MEGABYTE for size, _ in peak.held] == [4, 3, 2]
    table = peak_table("A step", peak)
    assert "**A step: 9.0 MB, 4.0 of them before it**" in table
    assert "| 4.0 | c.py:7 h |" in table
    assert "| 6.0 | 2 | c.py h |" in table
    assert "| 0.0 | 0 smaller ones |" in table


def test_without_events_the_peak_is_what_is_held() -> None:
    """Nothing was allocated: the moment is the beginning."""
    peak = peak_among([event("free_requested", 1)], {1: Allocation(5, ())})
    assert (peak.bytes, peak.held) == (5, [Allocation(5, ())])
    assert "| 0.0 | unknown |" in peak_table("Nothing", peak)


def test_lines_are_those_of_the_project() -> None:
    """The innermost first, without the machine's folders and without what allocates for others."""
    stack = [
        frame("/home/me/thermosplat/.venv/lib/python3.12/site-packages/torch/_tensor.py"),
        frame("/home/me/thermosplat/src/thermosplat/torch_bridge/streams.py", 80, "empty"),
        frame("/home/me/thermosplat/warp_kernels/binning/binning_step.py", 5, "bin_tiles"),
        frame("/home/me/thermosplat/src/thermosplat/rasterizer/projected_scene.py", 6, "tile_lists"),
        frame("/home/me/thermosplat/benchmarks/bench_distributed.py", 9, "measured"),
    ]
    assert lines_of(stack)[:2] == (
        "warp_kernels/binning/binning_step.py:5 bin_tiles",
        "rasterizer/projected_scene.py:6 tile_lists",
    )
    assert lines_of(stack[:1]) == ("_tensor.py:1 f",)
    assert lines_of([]) == ()


def test_what_a_snapshot_holds() -> None:
    """Blocks in use, with what was asked for; addresses follow one another where they are not given."""
    blocks = [
        {"state": "active_allocated", "size": 1024, "requested_size": 1000, "frames": [frame("/x/thermosplat/a.py")]},
        {"state": "inactive", "size": 512, "requested_size": 0},
        {"state": "active_allocated", "size": 512, "requested_size": 500},
    ]
    segments = [{"device": 0, "address": 100, "blocks": blocks}, {"device": 1, "address": 900, "blocks": blocks}]
    held = held_in(segments, torch.device("cuda", 0))
    assert held == {100: Allocation(1000, ("a.py:1 f",)), 1636: Allocation(500, ())}


@pytest.mark.cuda
def test_the_peak_of_recording_a_graph() -> None:
    """What is held before has its lines; what a graph works with is allocated while it is recorded, and reserved.

    Other tests of this process may have left tensors and graphs on the device, larger ones too.
    """
    device, graph = torch.device("cuda", 0), torch.cuda.CUDAGraph()
    gc.collect()  # recording begins with both of these: what they free must be gone before anything is counted
    torch.cuda.empty_cache()
    reserved_before, allocated_before = reserved_by_pool(device)["of graphs"]
    start_noting()
    try:
        held = torch.ones(8 * MEGABYTE, dtype=torch.uint8, device=device)

        def record() -> None:
            with torch.cuda.graph(graph):
                more = torch.cat([held, held])
                del more

        peak = peak_of(record, device)
        assert peak.bytes - peak.before >= 16 * MEGABYTE
        ours = [(size, where[0]) for size, where in peak.held if where and Path(__file__).name in where[0]]
        assert [size // MEGABYTE for size, _ in ours[:2]] == [16, 8]
        assert [line.rsplit(" ", 1)[1] for _, line in ours[:2]] == ["record", "test_the_peak_of_recording_a_graph"]
        reserved, allocated = reserved_by_pool(device)["of graphs"]
        assert reserved - reserved_before >= 16 * MEGABYTE > allocated - allocated_before
    finally:
        stop_noting()
