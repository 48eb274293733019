"""How much memory do segments of long lists take, and how much of it do they use? Counted on the CPU.

    python benchmarks/estimate_states.py --scene test_garden.npz huge --grid 1 5 --sizes 640x480 1297x840 --channels 32

Where few tiles have long lists, CUDA's blending cuts those longer than three segments, and keeps a state at every
boundary until the backward pass: for each pixel of the tile the light that is left, and a number for each channel
(docs/kernels.md). Room is reserved for a boundary at every segment's length of all pairs, since which lists are long
is known only after they are sorted, on the device. Here they are sorted on the CPU, and both are counted.
"""

import argparse
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import torch
import warp as wp

from scenes.benchmark_scenes import BenchmarkScene, garden_scene, huge_scene
from thermosplat.rasterizer import project
from warp_kernels.blending.blend_layout import default_layout
from warp_kernels.blending.list_segments import LONG_LIST

TILE = 16
FLOAT = 4
"""Bytes of a number."""


@torch.no_grad()
def states_of(scene: BenchmarkScene, width: int, height: int, channels: int) -> tuple[int, int, int, int]:
    """What is cut, and what that takes.

    Args:
        scene: Any.
        width: Of the image [px].
        height: Of the image [px].
        channels: Blended with one opacity.

    Returns:
        The number of pairs, of pairs in a segment (0: no list is cut), and of bytes that are reserved and used.
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
    if segment == 0:
        return pairs, 0, 0, 0
    begin, end = lists["tile_offsets"][:-1].long(), lists["tile_offsets"][1:].long()
    boundaries = (end - 1) // segment - begin // segment
    used = int(boundaries[lengths > LONG_LIST * segment].sum())
    state = (1 + channels) * TILE**2 * FLOAT
    return pairs, segment, (pairs // segment + 1) * state, used * state


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
    print("| scene | pairs [thousands] | segment | reserved [MiB] | used [MiB] |\n|---|---|---|---|---|")
    for make in makers:
        scene = make()
        for size in options.sizes:
            width, height = map(int, size.split("x"))
            pairs, segment, reserved, used = states_of(scene, width, height, options.channels)
            mib = f"{reserved / 2**20:.1f} | {used / 2**20:.1f}"
            print(f"| {scene.name} {size} | {pairs / 1e3:,.1f} | {segment} | {mib} |", flush=True)


if __name__ == "__main__":
    main()
