"""Which tensors lie in a CUDA device's memory when most of it is allocated, and which lines allocated them.

torch notes each allocation with the lines that asked for it. From these notes the moment of the peak is found. What a
CUDA graph works with is allocated while it is recorded, and belongs to the graph's pool from then on: torch's
``max_memory_allocated`` of replayed steps does not have it.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any, NamedTuple

import torch

ENTRIES = 2_000_000
"""Most allocations and frees that torch notes; a step has some thousand."""

LARGEST = 25
"""Tensors of the peak that are listed, the largest first."""

LINES = 3
"""Lines of the project that are shown of an allocation, the innermost first."""

ROOMS = ("thermosplat", "warp_kernels")
"""Folders whose lines are shown, from there on."""

PASSED_OVER = ("torch_bridge/", "machinery/")
"""Folders that allocate for others."""


class Allocation(NamedTuple):
    """Memory that is held."""

    bytes: int
    lines: tuple[str, ...]
    """``file:line function`` of the project's lines that led there, the innermost first."""


@dataclass(frozen=True)
class Peak:
    """The moment at which most was held."""

    bytes: int
    held: list[Allocation]
    """The largest first."""
    before: int
    """Bytes that were held at the beginning."""


def start_noting() -> None:
    """Let torch note who allocates, from now on. What is held already has no lines."""
    torch.cuda.memory._record_memory_history("all", context="alloc", stacks="python", max_entries=ENTRIES)


def stop_noting() -> None:
    """Note nothing any more."""
    torch.cuda.memory._record_memory_history(None)


def peak_of(work: Callable[[], object], device: torch.device) -> Peak:
    """The peak of some work, after ``start_noting``.

    Args:
        work: What allocates.
        device: A CUDA device.
    """
    torch.cuda.synchronize(device)
    stop_noting()  # forgets what was noted, but not the lines of what is held
    start_noting()
    held = held_in(torch.cuda.memory._snapshot(device)["segments"], device)
    work()
    torch.cuda.synchronize(device)
    return peak_among(torch.cuda.memory._snapshot(device)["device_traces"][device.index or 0], held)


def reserved_by_pool(device: torch.device) -> dict[str, tuple[int, int]]:
    """Bytes that are reserved, and those that are allocated: outside of recorded graphs and for them."""
    found = {"outside": (0, 0), "of graphs": (0, 0)}
    for segment in torch.cuda.memory._snapshot(device)["segments"]:
        if segment.get("device", device.index or 0) != (device.index or 0):
            continue
        name = "outside" if tuple(segment.get("segment_pool_id", (0, 0))) == (0, 0) else "of graphs"
        reserved, allocated = found[name]
        found[name] = (reserved + segment["total_size"], allocated + segment["allocated_size"])
    return found


def held_in(segments: Iterable[Mapping[str, Any]], device: torch.device) -> dict[int, Allocation]:
    """What is allocated in the segments of a snapshot, by address.

    Args:
        segments: The snapshot's.
        device: Whose.
    """
    found = {}
    for segment in segments:
        if segment.get("device", device.index or 0) != (device.index or 0):
            continue
        address = segment["address"]
        for block in segment["blocks"]:
            place = block.get("address", address)
            if block["state"] == "active_allocated":
                size = block.get("requested_size", block["size"])
                found[place] = Allocation(size, lines_of(block.get("frames", ())))
            address = place + block["size"]
    return found


def peak_among(events: Sequence[Mapping[str, Any]], held: Mapping[int, Allocation]) -> Peak:
    """The moment at which most was held.

    Args:
        events: torch's notes, in order: ``action`` "alloc" or "free_requested", ``addr``, ``size``, ``frames``.
        held: What is held before, by address.
    """
    sizes = {address: allocation.bytes for address, allocation in held.items()}
    before = total = most = sum(sizes.values())
    place = 0
    for number, event in enumerate(events, 1):
        if event["action"] == "alloc":
            sizes[event["addr"]] = event["size"]
            total += event["size"]
        elif event["action"] == "free_requested":
            total -= sizes.pop(event["addr"], 0)
        if total > most:
            most, place = total, number
    live = dict(held)
    for event in events[:place]:
        if event["action"] == "alloc":
            live[event["addr"]] = Allocation(event["size"], lines_of(event.get("frames", ())))
        elif event["action"] == "free_requested":
            live.pop(event["addr"], None)
    return Peak(most, sorted(live.values(), key=lambda allocation: -allocation.bytes), before)


def lines_of(frames: Iterable[Mapping[str, Any]]) -> tuple[str, ...]:
    """The project's lines that led to an allocation, the innermost first; without any, the innermost one at all.

    Args:
        frames: ``filename``, ``line``, ``name`` of each, the innermost first.
    """
    frames = list(frames)
    own = [line for frame in frames if (line := _line(frame)) is not None]
    if not own and frames:
        first = frames[0]
        return (f"{PurePath(first['filename']).name}:{first['line']} {first['name']}",)
    return tuple(own[:LINES])


def _line(frame: Mapping[str, Any]) -> str | None:
    parts = PurePath(frame["filename"]).parts
    room = next((place for place in reversed(range(len(parts))) if parts[place] in ROOMS), None)
    if room is None or room == len(parts) - 1 or "site-packages" in parts[room:]:
        return None
    kept = parts[room + 1 :] if parts[room] == ROOMS[0] else parts[room:]
    shown = "/".join(kept)
    if any(name in shown for name in PASSED_OVER):
        return None
    return f"{shown}:{frame['line']} {frame['name']}"


def peak_table(title: str, peak: Peak) -> str:
    """The largest tensors of a peak, and the sums of what each function allocated, as Markdown.

    Args:
        title: Of which work.
        peak: The peak.
    """
    lines = ["", f"**{title}: {_mb(peak.bytes)} MB, {_mb(peak.before)} of them before it**", ""]
    lines += ["| MB | allocated in |", "|---|---|"]
    lines += [f"| {_mb(size)} | {' < '.join(where) or 'unknown'} |" for size, where in peak.held[:LARGEST]]
    rest = peak.held[LARGEST:]
    lines += [f"| {_mb(sum(size for size, _ in rest))} | {len(rest)} smaller ones |", ""]
    sums: dict[str, list[int]] = defaultdict(list)
    for size, where in peak.held:
        sums[_function(where[0]) if where else "unknown"].append(size)
    lines += ["| MB | tensors | function |", "|---|---|---|"]
    for function, sizes in sorted(sums.items(), key=lambda entry: -sum(entry[1]))[:LARGEST]:
        lines.append(f"| {_mb(sum(sizes))} | {len(sizes)} | {function} |")
    return "\n".join([*lines, ""])


def _function(line: str) -> str:
    place, name = line.split(" ", 1)
    return f"{place.rsplit(':', 1)[0]} {name}"


def _mb(size: int) -> str:
    return f"{size / 1e6:.1f}"
