"""How fast is the rasterizer, and how exact? Beside gsplat 1.5.3 where that is installed.

    python benchmarks/bench_rasterization.py --device cpu
    python benchmarks/bench_rasterization.py --device cuda --scene test_garden.npz --grid 1 5 --json results.json

On the CPU the peer is gsplat's own torch reference, which needs ``gsplat_oracle.py`` (see README.md) on the path given
by --oracle. Every case checks that images and gradients agree before it is timed, and the JSON file is rewritten after
every case, so that an interrupted run keeps what it measured.
"""

import argparse
import json
import os
import platform
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
import warp as wp
from benchmark_scenes import BenchmarkScene, garden_scene, synthetic_scene
from peers import Peer, cpu_peers, cuda_peers
from stages import stage_times
from timing import peak_memory, time_interleaved
from torch import Tensor

CASES = ("rgb", "features", "rgbt")
"""rgb: SH colour of degree 3. features: 11 channels. rgbt: SH colour and 8 features at two opacities."""

CPU_SIZE, CUDA_SIZES = "320x240", ("640x480", "1297x840", "1920x1080")
PIXEL_TOLERANCE, SHARE_TOLERANCE = 1e-4, 1e-3
"""Images agree when fewer than SHARE of their values differ by more than PIXEL. Two implementations that round
differently may decide differently at alpha = 1/255 or transmittance = 1e-4, which shows in single pixels."""
GRADIENT_TOLERANCE = 1e-2
"""Relative norm; the same flips make up nearly all of it."""


def arguments() -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--scene", default="synthetic", help="'synthetic' or the path of gsplat's test_garden.npz")
    parser.add_argument("--count", type=int, nargs="+", default=None, help="Gaussians of the synthetic scene")
    parser.add_argument("--grid", type=int, nargs="+", default=[1], help="repetitions of the garden, odd")
    parser.add_argument("--sizes", nargs="+", default=None, help="WIDTHxHEIGHT ...")
    parser.add_argument("--cases", nargs="+", choices=CASES, default=None)
    parser.add_argument("--repeats", type=int, default=None, help="measurements a case (50 on CUDA, 11 on the CPU)")
    parser.add_argument("--json", type=Path, default=None, help="file to write")
    parser.add_argument(
        "--oracle", type=Path, default=Path(os.environ.get("THERMOSPLAT_TEST_ORACLE", "../shared/oracle"))
    )
    parser.add_argument("--no-peers", action="store_true", help="time thermosplat alone")
    return parser.parse_args()


def scenes(options: argparse.Namespace, on_cpu: bool) -> Iterator[BenchmarkScene]:
    """The scenes asked for, made one at a time."""
    if options.scene == "synthetic":
        for count in options.count or [20_000 if on_cpu else 1_000_000]:
            yield synthetic_scene(count)
    else:
        for grid in options.grid:
            yield garden_scene(Path(options.scene), grid)


def inputs_of(scene: BenchmarkScene, case: str, width: int, height: int, device: torch.device) -> dict[str, Tensor]:
    """The case's tensors on the device, as leaves."""
    tensors = {"means": scene.means, "quats": scene.quats, "scales": scene.scales, "opacities": scene.opacities}
    if case in ("rgb", "rgbt"):
        tensors["sh"] = scene.sh
    if case in ("features", "rgbt"):
        tensors["features"] = scene.features(11 if case == "features" else 8)
    if case == "rgbt":
        tensors["thermal_opacities"] = scene.thermal_opacities
    leaves = {name: tensor.to(device, copy=True).requires_grad_() for name, tensor in tensors.items()}
    leaves["viewmats"] = scene.viewmat[None].to(device)
    leaves["Ks"] = scene.intrinsics(width, height)[None].to(device)
    return leaves


def passes(render: Callable[[], list[Tensor]], inputs: dict[str, Tensor]) -> tuple[Callable, Callable]:
    """The forward pass without gradients, and forward plus backward with random gradients of every image."""
    leaves = [tensor for tensor in inputs.values() if tensor.requires_grad]
    with torch.no_grad():
        shapes = [image.shape for image in render()]
    generator = torch.Generator().manual_seed(0)
    device, dtype = inputs["means"].device, inputs["means"].dtype
    upstream = [torch.randn(shape, generator=generator).to(device, dtype) for shape in shapes]

    def forward() -> list[Tensor]:
        with torch.no_grad():
            return render()

    def forward_backward() -> tuple[list[Tensor], tuple[Tensor, ...]]:
        images = render()
        return images, torch.autograd.grad(images, leaves, upstream)

    return forward, forward_backward


def differences(one: tuple[Any, Any], other: tuple[Any, Any], names: list[str]) -> dict[str, float]:
    """How far images and gradients of two renderers are apart."""
    offs = torch.cat([(a.double() - b.double()).abs().flatten() for a, b in zip(one[0], other[0], strict=True)])
    result = {
        "image_mean": offs.mean().item(),
        "image_max": offs.max().item(),
        "image_share_above_1e-4": (offs > PIXEL_TOLERANCE).double().mean().item(),
    }
    for name, a, b in zip(names, one[1], other[1], strict=True):
        result[f"grad_{name}"] = ((a.double() - b.double()).norm() / b.double().norm().clamp(min=1e-30)).item()
    return result


def disagreement(found: dict[str, float]) -> str | None:
    """What is too far apart to compare times, if anything."""
    if not found["image_share_above_1e-4"] <= SHARE_TOLERANCE:
        return f"images differ: {found['image_share_above_1e-4']:.1%} of the values by more than {PIXEL_TOLERANCE}"
    wrong = [f"{k} {v:.1e}" for k, v in found.items() if k.startswith("grad_") and not v <= GRADIENT_TOLERANCE]
    return f"gradients differ: {', '.join(wrong)}" if wrong else None


def run_case(
    scene: BenchmarkScene, case: str, width: int, height: int, device: torch.device, peers: list[Peer], repeats: int
) -> dict[str, Any]:
    """Checks and times one case; returns its row."""
    inputs = inputs_of(scene, case, width, height, device)
    names = [name for name, tensor in inputs.items() if tensor.requires_grad]
    row: dict[str, Any] = {
        "scene": scene.name,
        "gaussians": len(scene.means),
        "size": f"{width}x{height}",
        "case": case,
    }
    both = {peer.name: passes(peer.renderer(case, inputs, width, height), inputs) for peer in peers}

    start = time.perf_counter()
    results = {name: forward_backward() for name, (_, forward_backward) in both.items()}
    row["first_call_s"] = round(time.perf_counter() - start, 2)
    ours = peers[0].name
    exact = {k: v.detach().double().requires_grad_(v.requires_grad) for k, v in inputs.items()}
    truth = passes(peers[0].renderer(case, exact, width, height), exact)[1]()
    row["error_to_float64"] = {name: differences(result, truth, names) for name, result in results.items()}
    others = {name: result for name, result in results.items() if name != ours}
    row["difference"] = {name: differences(result, results[ours], names) for name, result in others.items()}
    for name, found in row["difference"].items():
        if (reason := disagreement(found)) is not None:
            row["error"] = f"not timed: {name} and {ours} disagree: {reason}"
            return row
    del results, others, truth, exact

    row["forward"] = time_interleaved({name: forward for name, (forward, _) in both.items()}, device, repeats)
    row["forward_backward"] = time_interleaved({name: step for name, (_, step) in both.items()}, device, repeats)
    row["peak_memory_mib"] = {name: peak_memory(step, device) for name, (_, step) in both.items()}
    if case != "rgb":
        row["stages"], row["pairs"] = stage_times(inputs, width, height, repeats)
    return row


def print_row(row: dict[str, Any]) -> None:
    """One line a renderer."""
    head = f"{row['scene']:<16} {row['size']:>9} {row['case']:<8}"
    if "error" in row:
        print(f"{head} {row['error']}", flush=True)
        return
    for name, times in row["forward"].items():
        both, memory = row["forward_backward"][name], row["peak_memory_mib"][name]
        error = row["error_to_float64"][name]
        worst = max(value for key, value in error.items() if key.startswith("grad_"))
        print(
            f"{head} {name:<22} {times['median_ms']:>9.2f} {both['median_ms']:>9.2f} "
            f"{error['image_mean']:>9.1e} {worst:>9.1e} {'' if memory is None else f'{memory:>9.0f}'}",
            flush=True,
        )
    for stage, times in row.get("stages", {}).items():
        print(f"{'':35} . {stage:<20} {times['median_ms']:>9.2f}", flush=True)
    if "pairs" in row:
        print(f"{'':35} . {row['pairs']:,} (Gaussian, tile) pairs", flush=True)


def environment(device: torch.device, peers: list[Peer]) -> dict[str, Any]:
    """What the numbers depend on."""
    return {
        "command": " ".join(sys.argv),
        "date": time.strftime("%Y-%m-%d"),
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else platform.processor() or "cpu",
        "cpus": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "torch_threads": torch.get_num_threads(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "warp": wp.__version__,
        "renderers": {peer.name: peer.description for peer in peers},
    }


def write_json(path: Path | None, report: dict[str, Any]) -> None:
    """Replaces the file, so that it is whole at any time."""
    if path is None:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + ".part")
    temporary.write_text(json.dumps(report, indent=1) + "\n")
    temporary.replace(path)


def main() -> int:
    """Runs the cases asked for; returns 1 if any failed."""
    options = arguments()
    device = torch.device(options.device)
    on_cpu = device.type == "cpu"
    peers = cpu_peers(options.oracle, options.no_peers) if on_cpu else cuda_peers(options.no_peers)
    report: dict[str, Any] = {"environment": environment(device, peers), "rows": []}
    repeats = options.repeats or (11 if on_cpu else 50)
    sizes = options.sizes or ([CPU_SIZE] if on_cpu else list(CUDA_SIZES))
    print(f"{'scene':<16} {'size':>9} {'case':<8} {'renderer':<22} {'fwd ms':>9} {'f+b ms':>9} ", end="")
    print(f"{'img err':>9} {'grad err':>9} {'' if on_cpu else 'peak MiB':>9}", flush=True)
    for scene in scenes(options, on_cpu):
        for size in sizes:
            width, height = (int(number) for number in size.lower().split("x"))
            for case in options.cases or (("features", "rgbt") if on_cpu else CASES):
                try:
                    row = run_case(scene, case, width, height, device, peers, repeats)
                except Exception as error:  # one case that fails (out of memory, say) must not lose the others
                    traceback.print_exc()
                    row = {"scene": scene.name, "size": size, "case": case, "error": f"{type(error).__name__}: {error}"}
                print_row(row)
                report["rows"].append(row)
                write_json(options.json, report)
                if not on_cpu:
                    torch.cuda.empty_cache()
    return int(any("error" in row for row in report["rows"]))


if __name__ == "__main__":
    sys.exit(main())
