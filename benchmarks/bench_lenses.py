"""What does a lens cost? Plain pinhole cameras beside lenses and a rolling shutter, all in one process.

    python benchmarks/bench_lenses.py --device cuda --gaussians 1000000 --width 1920 --height 1080 --markdown lenses.md

Times forward passes, and forward and backward passes together, of ``rasterization`` with spherical harmonics of degree
3; "with cameras" also asks for gradients to poses, intrinsics and coefficients. At most 1.3 times the pinhole's time is
aimed at, on a GPU.

On a GPU calls that come again are replayed from CUDA graphs. All are called until they are, before anything is timed:
a lens that is not replayed beside a pinhole camera that is would be charged with the host's time. The last column says
how many of the timed calls were replayed. ``--plain`` replays none.
"""

import argparse
import platform
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from measuring.timing import time_interleaved
from scenes.benchmark_scenes import synthetic_scene
from thermosplat import RollingShutterType, rasterization
from thermosplat.rasterizer import replay
from thermosplat.rasterizer.replay.replayed_calls import PAYS, SEEN
from thermosplat.runs.atomic_writes import write_text

SETTLED = SEEN + PAYS + 1
"""Calls after which one is replayed that can be, and the next one does not have to wait longer."""


def lenses(viewmats: Tensor) -> dict[str, dict[str, Any]]:
    """Arguments by name; each lens bends an image of 60 degrees visibly."""

    def row(*values: float) -> Tensor:
        return viewmats.new_tensor([values])

    end = viewmats.clone()
    end[..., 0, 3] += 0.05
    rolling = {"rolling_shutter": RollingShutterType.ROLLING_TOP_TO_BOTTOM, "viewmats_rs": end}
    radial = {"radial_coeffs": row(-0.2, 0.05, 0.0, 0.0, 0.0, 0.0)}
    return {
        "pinhole": {},
        "radial": radial,
        "fisheye": {"camera_model": "fisheye", "radial_coeffs": row(-0.03, 0.004, -0.002, 0.0003)},
        "radial, rolling shutter": radial | rolling,
    }


def passes(inputs: dict[str, Any], lens: dict[str, Any]) -> dict[str, Callable[[], object]]:
    """What is timed of one lens, by name."""
    gaussians = ("means", "quats", "scales", "opacities", "colors")
    learnt = inputs | {name: inputs[name].clone().requires_grad_() for name in gaussians}
    cameras = {name: x.clone().requires_grad_() for name, x in lens.items() if isinstance(x, Tensor)}
    posed = learnt | {name: inputs[name].clone().requires_grad_() for name in ("viewmats", "Ks")}

    def forward() -> None:
        with torch.no_grad():
            rasterization(**inputs, **lens)

    def both(given: dict[str, Any], lens: dict[str, Any]) -> None:
        image, _, _ = rasterization(**given, **lens)
        image.square().mean().backward()

    return {
        "forward": forward,
        "forward and backward": partial(both, learnt, lens),
        "with cameras": partial(both, posed, lens | cameras),
    }


class Counted:
    """A call, of which those are counted that are replayed.

    Args:
        call: Of ``rasterization``, once.
    """

    def __init__(self, call: Callable[[], object]) -> None:
        self._call = call
        self.replayed = 0

    def __call__(self) -> None:
        """Calls."""
        before = replay.counts()["rasterization"].replayed
        self._call()
        self.replayed += replay.counts()["rasterization"].replayed - before


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--gaussians", type=int, default=100_000)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=480)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--plain", action="store_true", help="replay nothing")
    parser.add_argument("--markdown", type=Path, default=None, help="file to write")
    options = parser.parse_args()
    device = torch.device(options.device)
    scene = synthetic_scene(options.gaussians).to(device)
    inputs = {
        "means": scene.means,
        "quats": scene.quats,
        "scales": scene.scales,
        "opacities": scene.opacities,
        "colors": scene.sh,
        "viewmats": scene.viewmat[None],
        "Ks": scene.intrinsics(options.width, options.height)[None],
        "width": options.width,
        "height": options.height,
        "sh_degree": 3,
    }
    replay.enable(not options.plain)
    calls = {
        (lens, name): Counted(call)
        for lens, arguments in lenses(inputs["viewmats"]).items()
        for name, call in passes(inputs, arguments).items()
    }
    if device.type == "cuda" and not options.plain:
        for call in calls.values():
            for _ in range(SETTLED):
                call()
    for call in calls.values():
        call.replayed = 0
    found = time_interleaved({f"{lens}: {name}": call for (lens, name), call in calls.items()}, device, options.repeats)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else f"{platform.machine()} CPU"
    columns = list(passes(inputs, {}))
    lines = [
        f"{time.strftime('%Y-%m-%d')}, {name}, torch {torch.__version__}: {options.gaussians:,} Gaussians, "
        f"{options.width}x{options.height} px. Median of {options.repeats} [ms], and how many times the pinhole's.",
        "",
        f"| lens | {' | '.join(columns)} | replayed |",
        "|---|" + "---|" * (len(columns) + 1),
    ]
    for lens in lenses(inputs["viewmats"]):
        cells = []
        for column in columns:
            median, plain = (found[f"{one}: {column}"]["median_ms"] for one in (lens, "pinhole"))
            cells.append(f"{median:.2f} ({median / plain:.2f})")
        replayed = ", ".join(str(calls[lens, column].replayed) for column in columns)
        lines.append(f"| {lens} | {' | '.join(cells)} | {replayed} |")
    print("\n".join(lines))
    if options.markdown is not None:
        write_text(options.markdown, "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
