"""Which deal of pixels to lanes blends fastest? Times the blending kernels alone on CUDA over layouts and channels.

    python benchmarks/bench_blend_layouts.py --asset test_garden.npz --json layouts.json

The answers are built into ``warp_kernels.blend_layout.default_layout``.
"""

import argparse
import json
import statistics
from pathlib import Path

import torch
import warp as wp
from garden_scene import load_garden

from thermosplat.rasterization_functions import Project, ProjectedTensors, bin_tiles
from thermosplat.warp_bridge import wrap
from thermosplat.warp_streams import on_torch_stream
from warp_kernels.blend_layout import BlendLayout
from warp_kernels.blending_step import BlendedArrays, blend
from warp_kernels.projection import ProjectionSettings

LAYOUTS = [(16, 8, 4), (16, 8, 8), (16, 16, 8), (8, 8, 4), (8, 8, 8), (32, 8, 8), (32, 16, 8)]
CHANNELS = [(3, 0), (11, 0), (11, 8), (32, 0)]


def median_ms(run, repeats: int) -> float:
    """Median CUDA time of a call."""
    for _ in range(3):
        run()
    times = []
    for _ in range(repeats):
        start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        start.record()
        run()
        end.record()
        torch.cuda.synchronize()
        times.append(start.elapsed_time(end))
    return statistics.median(times)


def bench(scene: dict[str, torch.Tensor], width: int, height: int, repeats: int) -> list[dict]:
    """All layouts and channel counts on one scene and size."""
    count = len(scene["means"])
    settings = ProjectionSettings(width, height, count, 1, 1)
    opacities = scene["opacities"]
    thermal = opacities.flip(0).contiguous()
    with torch.no_grad():
        projected = Project.apply(
            scene["means"], scene["quats"], scene["scales"], None, opacities, thermal, scene["viewmats"], scene["Ks"],
            settings, (1,),
        )  # fmt: skip
    rows = []
    for tile_size in sorted({layout[0] for layout in LAYOUTS}):
        flat = torch.rand(count, 32, device="cuda")
        arrays = ProjectedTensors(*projected).arrays()
        bins = bin_tiles(arrays, opacities, thermal, flat, settings, tile_size)
        for channels, thermal_channels in CHANNELS:
            features = flat[:, :channels].contiguous()
            vec = wp.types.vector(channels, wp.float32)
            vec_t = wp.types.vector(max(thermal_channels, 1), wp.float32)
            for _, block_width, block_height in [layout for layout in LAYOUTS if layout[0] == tile_size]:
                layout = BlendLayout(tile_size, block_width, block_height, 32)
                with on_torch_stream(features.device) as device:

                    def image(kind, device=device):
                        grad = kind is not wp.int32
                        return wp.zeros((height, width), dtype=kind, device=device, requires_grad=grad)

                    blended = BlendedArrays(image(vec), image(wp.float32), image(wp.int32))
                    if thermal_channels:
                        blended.thermal_render, blended.thermal_transmittance = image(vec_t), image(wp.float32)
                        blended.thermal_last_pairs = image(wp.int32)
                    tape = wp.Tape()
                    args = (
                        arrays, wrap(opacities, wp.float32), wrap(thermal, wp.float32), wrap(features, vec), bins,
                        settings, blended,
                    )  # fmt: skip

                    def forward(args=args, layout=layout):
                        blend(*args, None, layout=layout)

                    blend(*args, tape, layout=layout)
                    blended.render.grad.fill_(vec(*[0.5] * channels))
                    row = {
                        "gaussians": count, "width": width, "height": height, "pairs": bins.num_pairs,
                        "tile_size": tile_size, "block": f"{block_width}x{block_height}", "channels": channels,
                        "thermal_channels": thermal_channels, "forward_ms": median_ms(forward, repeats),
                        "backward_ms": median_ms(tape.backward, repeats),
                    }  # fmt: skip
                rows.append(row)
                print(
                    "{gaussians:>9} {width}x{height} pairs {pairs:>9} tile {tile_size:>2} block {block:>5} "
                    "C {channels:>2}+{thermal_channels} forward {forward_ms:.3f} backward {backward_ms:.3f}".format(
                        **row
                    ),
                    flush=True,
                )
    return rows


def main() -> None:
    """Parses arguments, runs, prints and saves."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--asset", type=Path, help="gsplat's test_garden.npz")
    parser.add_argument("--grids", type=int, nargs="+", default=[1, 5])
    parser.add_argument("--sizes", nargs="+", default=["640x480", "1920x1080"])
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows = []
    for grid in args.grids:
        for size in args.sizes:
            width, height = (int(x) for x in size.split("x"))
            rows += bench(
                load_garden(args.asset, grid, width, height, torch.device("cuda")), width, height, args.repeats
            )
            if args.json:
                args.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
