"""Which deal of pixels to lanes blends fastest, and how long may a list be? Times the blending kernels alone on CUDA.

    python benchmarks/bench_blend_layouts.py --scene test_garden.npz results/desk --data DATA --json layouts.json

Over layouts, channels and segments (pairs of a list that one block of the adjoint walks; 0: the whole list). The
answers are built into ``warp_kernels.blending.blend_layout.default_layout``.
"""

import argparse
import json
import statistics
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import torch
import warp as wp

from scenes.benchmark_scenes import BenchmarkScene, garden_scene
from scenes.trained_scene import trained_scene
from thermosplat.rasterizer.projected_scene import tile_lists
from thermosplat.rasterizer.projection_autograd import Project, ProjectInputs
from thermosplat.runs.atomic_writes import write_text
from thermosplat.torch_bridge.arrays import view
from thermosplat.torch_bridge.streams import on_torch_stream
from warp_kernels.blending.blend_layout import BlendLayout
from warp_kernels.blending.blended_arrays import BlendedArrays
from warp_kernels.blending.blending_step import blend
from warp_kernels.projection.projection import ProjectionSettings


def median_ms(run: Callable[[], object], repeats: int) -> float:
    """Median CUDA time of a call; the host runs ahead."""
    for _ in range(3):
        run()
    events = [[torch.cuda.Event(enable_timing=True) for _ in range(2)] for _ in range(repeats)]
    torch.cuda._sleep(20_000_000)
    for start, end in events:
        start.record()
        run()
        end.record()
    torch.cuda.synchronize()
    return statistics.median(start.elapsed_time(end) for start, end in events)


def bench(scene: BenchmarkScene, width: int, height: int, args: argparse.Namespace) -> list[dict]:
    """All layouts and channel counts on one scene and size."""
    count = len(scene.means)
    settings = ProjectionSettings(width, height, count, 1, 1)
    opacities, thermal = scene.opacities, scene.thermal_opacities
    bounds = (view(opacities, wp.float32), view(thermal, wp.float32))
    with torch.no_grad():
        *_projected, arrays = Project.apply(
            scene.means, scene.quats, scene.scales, None, scene.viewmat[None], scene.intrinsics(width, height)[None],
            None, None, ProjectInputs(*bounds, settings, (), (1,), nullcontext()),
        )  # fmt: skip
    flat = scene.features(max(channels for channels, _ in args.channels))
    bins, memory = tile_lists(arrays, *bounds, flat, settings, args.tile_size)
    longest = int(torch.diff(memory["tile_offsets"]).max())
    rows = []
    for channels, thermal_channels in args.channels:
        features = flat[:, :channels].contiguous()
        vec = wp.types.vector(channels, wp.float32)
        vec_t = wp.types.vector(max(thermal_channels, 1), wp.float32)
        for block_width, block_height in args.blocks:
            for segment in args.segments:
                layout = BlendLayout(args.tile_size, block_width, block_height, 32, segment)
                with on_torch_stream(features.device) as device:

                    def image(kind, device=device):
                        grad = kind is not wp.int32
                        return wp.zeros((height, width), dtype=kind, device=device, requires_grad=grad)

                    blended = BlendedArrays(image(vec), image(wp.float32), image(wp.int32))
                    if thermal_channels:
                        blended.thermal_render, blended.thermal_transmittance = image(vec_t), image(wp.float32)
                        blended.thermal_ends = image(wp.int32)
                    tape = wp.Tape()
                    inputs = (
                        arrays, wp.from_torch(opacities), wp.from_torch(thermal), wp.from_torch(features, vec), bins,
                        settings, blended,
                    )  # fmt: skip

                    def forward(inputs=inputs, layout=layout):
                        blend(*inputs, layout=layout)

                    blend(*inputs, tape, layout=layout)
                    blended.render.grad.fill_(vec(*[0.5] * channels))
                    row = {
                        "scene": scene.name, "gaussians": count, "width": width, "height": height,
                        "pairs": bins.num_pairs, "longest_list": longest, "tile_size": args.tile_size,
                        "block": f"{block_width}x{block_height}", "segment": segment, "channels": channels,
                        "thermal_channels": thermal_channels, "forward_ms": median_ms(forward, args.repeats),
                        "backward_ms": median_ms(tape.backward, args.repeats),
                    }  # fmt: skip
                rows.append(row)
                print(
                    "{scene} {width}x{height} pairs {pairs:>9} longest {longest_list:>5} block {block:>5} segment "
                    "{segment:>4} C {channels:>2}+{thermal_channels} forward {forward_ms:.3f} backward "
                    "{backward_ms:.3f}".format(**row),
                    flush=True,
                )
    return rows


def main() -> None:
    """Parses arguments, runs, prints and saves."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", type=Path, nargs="+", required=True, help="gsplat's test_garden.npz, result folders")
    parser.add_argument("--data", help="where the capture of trained scenes lies now")
    parser.add_argument("--grid", type=int, nargs="+", default=[1, 5])
    parser.add_argument("--sizes", nargs="+", default=["640x480", "1920x1080"])
    parser.add_argument("--blocks", nargs="+", default=["8x4", "8x8", "16x8"])
    parser.add_argument("--channels", nargs="+", default=["3+0", "11+0", "11+8", "32+0"], help="blended + again")
    parser.add_argument("--segments", type=int, nargs="+", default=[0, 256, 512, 1024])
    parser.add_argument("--tile-size", type=int, default=16)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    args.blocks = [tuple(int(edge) for edge in block.split("x")) for block in args.blocks]
    args.channels = [tuple(int(count) for count in channels.split("+")) for channels in args.channels]
    scenes = []
    for path in args.scene:
        scenes += (
            [garden_scene(path, grid) for grid in args.grid]
            if path.suffix == ".npz"
            else [trained_scene(path, args.data)]
        )
    rows = []
    for scene in scenes:
        for size in args.sizes:
            width, height = (int(x) for x in size.split("x"))
            rows += bench(scene.to(torch.device("cuda")), width, height, args)
            if args.json:
                write_text(args.json, json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
