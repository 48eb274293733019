"""How fast is the rasterizer, and how exact? Beside gsplat, its main branch, Faster-GS and gswarp where installed.

    python benchmarks/bench_rasterization.py --device cpu --cores 1 2
    python benchmarks/bench_rasterization.py --device cuda --scene test_garden.npz huge results/desk --grid 1 5 11 \\
        --peers gsplat gsplat-main faster-gs gswarp --json rasterization.json --markdown rasterization.md

Every case checks that images and gradients agree before it is timed, and the files are rewritten after every case, so
that an interrupted run keeps what it measured. README.md says what is compared and how it is measured.
"""

import argparse
import gc
import json
import os
import platform
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
import warp as wp

from measuring.agreement import largest
from measuring.device_peaks import DevicePeaks, measure_peaks
from peers.installed import MAKERS, cuda_peers
from peers.peer import CASES, Peer
from peers.renderers import PEERS, cpu_peers
from rasterization.case import one_line, run_case
from rasterization.changing import changing_rows
from rasterization.summary import summaries, summary_lines
from rasterization.tables import markdown
from scenes.benchmark_scenes import BenchmarkScene, garden_scene, huge_scene, synthetic_scene
from scenes.trained_scene import trained_scene
from thermosplat.runs.atomic_writes import write_text

CPU_CASES = ("features11", "rgbt")
CPU_SIZE, CUDA_SIZES = "320x240", ("640x480", "1297x840", "1920x1080", "3840x2160")
TRUTH_PIXELS = 1920 * 1080


def arguments() -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument(
        "--scene",
        nargs="+",
        default=["synthetic"],
        help="'synthetic', 'huge', the path of gsplat's test_garden.npz, and of trained runs: a result folder, a "
        "checkpoint, or an exported PLY",
    )
    parser.add_argument("--data", default=None, help="where the capture of trained scenes lies now, for its camera")
    parser.add_argument("--count", type=int, nargs="+", default=None, help="Gaussians of the synthetic and huge scenes")
    parser.add_argument("--grid", type=int, nargs="+", default=[1], help="repetitions of the garden, odd")
    parser.add_argument("--sizes", nargs="+", default=None, help="WIDTHxHEIGHT ...")
    parser.add_argument("--cases", nargs="+", choices=CASES, default=None)
    parser.add_argument("--repeats", type=int, default=None, help="measurements a case (50 on CUDA, 11 on the CPU)")
    parser.add_argument("--time-limit", type=float, default=None, help="start no case after so long [s]")
    parser.add_argument(
        "--truth-gaussians", type=int, default=1_000_000, help="compare with float64 up to so many, and up to 1920x1080"
    )
    parser.add_argument(
        "--changing", action="store_true", help="in place of cases: loops whose sizes take turns, or that get Gaussians"
    )
    parser.add_argument("--no-stages", action="store_true", help="neither stages nor floors")
    parser.add_argument("--cores", type=int, nargs="+", default=None, help="CPU threads to time thermosplat with")
    parser.add_argument(
        "--one-thread",
        action="store_true",
        help="run backward passes in the calling thread, where torch hands those of a GPU to a thread of its own",
    )
    parser.add_argument("--json", type=Path, default=None, help="file to write")
    parser.add_argument(
        "--resume", action="store_true", help="keep what --json holds, and measure only what is not in it"
    )
    parser.add_argument("--markdown", type=Path, default=None, help="file to write the tables to")
    parser.add_argument(
        "--peers",
        nargs="*",
        choices=sorted({*PEERS, *MAKERS, "deterministic"}),
        default=list(PEERS),
        help="beside whom; on CUDA 'callable' is thermosplat under torch.cuda.make_graphed_callables, 'graph' in a "
        "CUDA graph, 'eager' without the graphs that its calls make themselves where they come again, and "
        "'deterministic' with deterministic=True; none: thermosplat alone. peers/README.md says how the others are "
        "installed. Beside gsplat, gsplat-main is measured in a process of its own, after the rest",
    )
    options = parser.parse_args()
    if options.resume and options.json is None:
        parser.error("--resume needs the --json of the run it goes on with")
    options.no_stages |= options.changing
    return options


def scenes(options: argparse.Namespace, on_cpu: bool) -> Iterator[BenchmarkScene | tuple[str, Exception]]:
    """The scenes asked for, made one at a time; in place of one that cannot be made, its name and why."""
    makers: list[tuple[str, Callable[[], BenchmarkScene]]] = []
    for name in options.scene:
        if name in ("synthetic", "huge"):
            make = synthetic_scene if name == "synthetic" else huge_scene
            default = 20_000 if on_cpu else 1_000_000 if name == "synthetic" else 300_000
            makers += [(name, lambda make=make, n=n: make(n)) for n in options.count or [default]]
        elif name.endswith(".npz"):
            makers += [(name, lambda name=name, grid=grid: garden_scene(Path(name), grid)) for grid in options.grid]
        else:
            makers.append((name, lambda name=name: trained_scene(Path(name), options.data)))
    for name, maker in makers:
        try:
            yield maker()
        except Exception as error:  # a path that is wrong must not lose the other scenes
            traceback.print_exc()
            yield name, error


def print_row(row: dict[str, Any]) -> None:
    """One line a renderer, then its stages."""
    head = f"{row['scene']:<16} {row['size']:>9} {row['case']:<10}"
    if "error" in row:
        print(f"{head} {row['error']}", flush=True)
        return
    if "changing" in row:
        for name, times in row["changing"].items():
            per_call = times["ms_per_call"]
            print(
                f"{head} {name:<22} {row['loop']}: {per_call['median_ms']:.2f} ms a call ({per_call['p10_ms']:.2f} "
                f"to {per_call['p90_ms']:.2f}), the first of a turn {times['first_ms']:.2f}",
                flush=True,
            )
        return
    for name, times in row["forward"].items():
        both, memory, pairs = row["forward_backward"][name], row["peak_memory_mib"][name], row["intersections"][name]
        line = f"{head} {name:<22} {times['median_ms']:>9.2f} {both['median_ms']:>9.2f} {both['host_ms']:>9.2f}"
        if (error := row["error_to_float64"].get(name)) is not None:
            worst = largest(value for key, value in error.items() if key.startswith("grad_"))
            line += f" {error['image_rms']:>9.1e} {error['image_max']:>9.1e} {worst:>9.1e}"
        else:
            line += f"{'-':>10}" * 3
        line += f"{'-' if memory is None else format(memory, '.0f'):>10}{'-' if pairs is None else pairs:>12}"
        print(line + (f"  * {row['apart'][name]}" if name in row["apart"] else ""), flush=True)
    for name, reason in row["left_out"].items():
        print(f"{head} {name:<22} not timed: {reason}", flush=True)
    for stage, times in row.get("stages", {}).items():
        print(f"{'':37} . {stage:<20} {times['median_ms']:>9.3f} {times['times_floor']:>7.1f}x its floor", flush=True)
    for count, times in row.get("cores", {}).items():
        print(f"{'':37} . {count + ' threads':<20} {times['forward']:>9.2f} {times['forward_backward']:>9.2f}")
    if "fragments" in row:
        print(f"{'':37} . {row['fragments']['either']:,} fragments", flush=True)


def environment(device: torch.device, peers: list[Peer]) -> dict[str, Any]:
    """What the numbers depend on."""
    return {
        "command": " ".join(["python", "benchmarks/bench_rasterization.py", *sys.argv[1:]]),
        "date": time.strftime("%Y-%m-%d"),
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else platform.processor() or "cpu",
        "cpus": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "torch_threads": torch.get_num_threads(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "warp": wp.__version__,
        "renderers": {peer.name: peer.description for peer in peers},
    }


def write_report(report: dict[str, Any], json_path: Path | None, markdown_path: Path | None) -> None:
    """Replaces the files, so that they are whole at any time."""
    report["summaries"] = summaries(report["rows"])
    for path, text in (
        (json_path, lambda: json.dumps(report, indent=1) + "\n"),
        (markdown_path, lambda: markdown(report)),
    ):
        if path is not None:
            write_text(path, text())


def width_and_height(size: str) -> tuple[int, int]:
    """Of WIDTHxHEIGHT."""
    width, height = (int(number) for number in size.lower().split("x"))
    return width, height


def run(options: argparse.Namespace, device: torch.device, peers: list[Peer], report: dict[str, Any]) -> None:
    """Fills the report's rows, case by case."""
    start_s, on_cpu = time.perf_counter(), device.type == "cpu"
    peaks = None if options.no_stages else DevicePeaks(**report["peaks"])
    repeats = options.repeats or (11 if on_cpu else 50)

    def note(row: dict[str, Any]) -> None:
        print_row(row)
        report["rows"].append(row)
        write_report(report, options.json, options.markdown)

    done = {(row["scene"], row["size"], row["case"]) for row in report["rows"]}
    for scene in scenes(options, on_cpu):
        if isinstance(scene, tuple):
            note({"scene": scene[0], "size": "", "case": "", "error": one_line(scene[1])})
            continue
        scene = scene.to(device)
        sizes, cases = (
            options.sizes or ([CPU_SIZE] if on_cpu else CUDA_SIZES),
            options.cases or (CPU_CASES if on_cpu else CASES),
        )
        if options.changing:
            for case in cases:
                try:
                    for row in changing_rows(scene, case, [width_and_height(size) for size in sizes], device, peers):
                        note(row)
                except Exception as error:  # as below
                    traceback.print_exc()
                    note({"scene": scene.name, "size": sizes[0], "case": case, "error": one_line(error)})
            continue
        for size in sizes:
            width, height = width_and_height(size)
            with_truth = width * height <= TRUTH_PIXELS and len(scene.means) <= options.truth_gaussians
            for case in cases:
                if (scene.name, size, case) in done:
                    continue
                if options.time_limit is not None and time.perf_counter() - start_s > options.time_limit:
                    report["stopped"] = (
                        f"the time limit of {options.time_limit:g} s came before {scene.name} {size} {case}"
                    )
                    print(report["stopped"], flush=True)
                    return
                try:
                    row = run_case(
                        scene,
                        case,
                        (width, height),
                        device,
                        peers,
                        repeats,
                        with_truth=with_truth,
                        peaks=peaks,
                        cores=options.cores if on_cpu else None,
                    )
                except Exception as error:  # one case that fails (out of memory, say) must not lose the others
                    traceback.print_exc()
                    row = {"scene": scene.name, "size": size, "case": case, "error": one_line(error)}
                note(row)
                if not on_cpu:
                    gc.collect()  # torch's graphed callables hold themselves, and with them their graphs' memory
                    torch.cuda.empty_cache()


def in_two_processes(given: list[str], options: argparse.Namespace) -> int:
    """Measures gsplat-main in a process of its own, after the other peers: two gsplats do not fit into one.

    Args:
        given: the command line.
        options: what it says.

    Returns:
        1 if either process failed.
    """
    codes = []
    for peers in ([name for name in options.peers if name != "gsplat-main"], ["gsplat-main"]):
        words = [*given, "--peers", *peers]  # the last one counts
        if peers == ["gsplat-main"]:
            for flag, path in (("--json", options.json), ("--markdown", options.markdown)):
                if path is not None:
                    words += [flag, str(path.with_stem(f"{path.stem}-gsplat-main"))]
            print("\ngsplat-main, in a process of its own:", flush=True)
        codes.append(subprocess.run([sys.executable, __file__, *words], check=False).returncode)
    return int(any(codes))


def main() -> int:
    """Runs the cases asked for; returns 1 if any failed, or a peer rendered something else."""
    options = arguments()
    if {"gsplat", "gsplat-main"} <= {*options.peers}:
        return in_two_processes(sys.argv[1:], options)
    device = torch.device(options.device)
    if options.one_thread:
        torch.autograd.set_multithreading_enabled(False)
    peers = cpu_peers(options.peers) if device.type == "cpu" else cuda_peers(options.peers)
    report: dict[str, Any] = {"environment": environment(device, peers), "rows": []}
    if options.resume and options.json.exists():
        report["rows"] = [row for row in json.loads(options.json.read_text())["rows"] if "error" not in row]
    if not options.no_stages:
        report["peaks"] = measure_peaks(device)._asdict()
        print(
            f"peaks: {report['peaks']['bytes_per_s'] / 1e9:.0f} GB/s, {report['peaks']['flops_fp32'] / 2e9:.0f} GFMA/s"
        )
    print(f"{'scene':<16} {'size':>9} {'case':<10} {'renderer':<22} {'fwd ms':>9} {'f+b ms':>9} {'host ms':>9}", end="")
    print(f" {'img rms':>9} {'img max':>9} {'grad err':>9} {'peak MiB':>9} {'pairs':>11}", flush=True)
    run(options, device, peers, report)
    write_report(report, options.json, options.markdown)
    for found in report["summaries"]:
        print("\n" + "\n".join(summary_lines(found)), flush=True)
    return int(any("error" in row or row.get("apart") for row in report["rows"]))


if __name__ == "__main__":
    sys.exit(main())
