"""How much memory do renders with many channels take, and how much of it do segments of long lists? Counted on the CPU.

    python benchmarks/estimate_states.py --scene test_garden.npz huge --grid 1 5 --sizes 640x480 1297x840 --channels 32

Where few tiles have long lists, CUDA's blending cuts those longer than three segments, and keeps a state at every
boundary until the backward pass: for each pixel of the tile the light that is left, and a number for each channel
(docs/kernels.md). Calls in CUDA graphs have room for a boundary at every segment's length of all pairs, since which
lists are long is known only after they are sorted, on the device. So have others where that is little. Where it is
much, they wait for the number of boundaries. Here lists are sorted on the CPU, and both are counted.

The peak is the larger of two: inside the adjoint of the blending, and inside that of the projection. What lies there is
counted byte by byte, for features that are blended with one opacity.
"""

import argparse
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import torch
import warp as wp

from scenes.benchmark_scenes import BenchmarkScene, garden_scene, huge_scene
from thermosplat.rasterizer import project
from warp_kernels.blending.blend_layout import default_layout
from warp_kernels.blending.blending_step import WORTH_A_WAIT
from warp_kernels.blending.list_segments import LONG_LIST

TILE = 16
FLOAT = 4
"""Bytes of a number."""


class Counts(NamedTuple):
    """What a frame has."""

    gaussians: int
    pixels: int
    pairs: int
    segment: int
    """Pairs in a segment; 0: no list is cut."""
    reserved: int
    """Bytes of states that there is room for in a CUDA graph."""
    used: int
    """Bytes of states in cut lists."""

    @property
    def made(self) -> int:
        """Bytes of states that there is room for in a plain call."""
        return self.used if self.reserved >= WORTH_A_WAIT else self.reserved


def peak_bytes(frame: Counts, channels: int, states: int) -> int:
    """What a forward and a backward pass hold at most, what they return included.

    Args:
        frame: Any.
        channels: More than 4, whose gradients are added up where they lie.
        states: Bytes that there is room for.
    """
    image = (channels + 1) * FLOAT * frame.pixels
    # roots, and who is visible; gradients to features, positions, roots and opacities
    in_both = (16 + 1 + FLOAT * channels + 24) * frame.gaussians
    # positions; last pairs; Gaussians and masks of the list
    in_blending = 8 * frame.gaussians + 4 * frame.pixels + 5 * frame.pairs + states
    # gradients to means and quaternions; those to scales are made where those to the roots lie
    in_projection = 28 * frame.gaussians
    return image + in_both + max(in_blending, in_projection)


@torch.no_grad()
def counts_of(scene: BenchmarkScene, width: int, height: int, channels: int) -> Counts:
    """Counts of a frame.

    Args:
        scene: Any.
        width: Of the image [px].
        height: Of the image [px].
        channels: Blended with one opacity.

    Returns:
        The counts.
    """
    projected = project(
        scene.means, scene.quats, scene.scales, scene.opacities, scene.viewmat[None],
        scene.intrinsics(width, height)[None], width, height, tile_size=TILE,
    )  # fmt: skip
    lists = projected.binned(scene.features(1)).tensors
    lengths = lists["tile_offsets"].diff()
    pairs, tiles = len(lists["gaussian_ids"]), len(lengths)
    cuda = SimpleNamespace(is_cuda=True)
    segment = default_layout(cuda, TILE, channels, 0, wp.float32, pairs, tiles).segment
    frame = Counts(len(scene.means), width * height, pairs, segment, 0, 0)
    if segment == 0:
        return frame
    begin, end = lists["tile_offsets"][:-1].long(), lists["tile_offsets"][1:].long()
    boundaries = (end - 1) // segment - begin // segment
    used = int(boundaries[lengths > LONG_LIST * segment].sum())
    state = (1 + channels) * TILE**2 * FLOAT
    return frame._replace(reserved=pairs // segment * state, used=used * state)


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", nargs="+", default=["huge"], help="huge, or the path of gsplat's test_garden.npz")
    parser.add_argument("--grid", nargs="+", type=int, default=[1], help="repetitions of the garden")
    parser.add_argument("--count", type=int, default=300_000, help="Gaussians of the huge scene")
    parser.add_argument("--sizes", nargs="+", default=["640x480"])
    parser.add_argument("--channels", type=int, default=32)
    options = parser.parse_args()
    makers = [partial(huge_scene, options.count)] if "huge" in options.scene else []
    gardens = [Path(name) for name in options.scene if name != "huge"]
    makers += [partial(garden_scene, garden, grid) for garden in gardens for grid in options.grid]
    columns = "pairs [thousands] | segment | reserved [MiB] | used [MiB] | peak [MiB] | peak in a graph [MiB]"
    print(f"| scene | {columns} |\n|---|---|---|---|---|---|---|")
    for make in makers:
        scene = make()
        for size in options.sizes:
            width, height = map(int, size.split("x"))
            frame = counts_of(scene, width, height, options.channels)
            peaks = [peak_bytes(frame, options.channels, states) for states in (frame.made, frame.reserved)]
            cells = [f"{size / 2**20:.1f}" for size in (frame.reserved, frame.used, *peaks)]
            counts = f"{frame.pairs / 1e3:,.1f} | {frame.segment}"
            print(f"| {scene.name} {width}x{height} | {counts} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
