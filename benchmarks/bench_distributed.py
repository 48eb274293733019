"""How fast do several devices train one scene beside one, and how much memory does each take?

    python benchmarks/bench_distributed.py --ranks 1 2 --counts 1000000 4000000 --size 1280x1024 --batch 2
    python benchmarks/bench_distributed.py --profile --memory-peak --steps 20
    python benchmarks/bench_distributed.py --device cpu --ranks 1 2 --counts 5000 --size 160x120 --batch 2 --steps 3

Random Gaussians fill the view of random images of two spectra. The steps are those of thermosplat-train without density
control. A row is a process, or so many: images per second, the most memory of a rank, and of its step the part spent in
the exchange of Gaussians and gradients (measured in further steps line by line, in which each exchange is waited for).
Recorded steps work in memory that was allocated while they were recorded: "reserved" has it, "memory" does not.

--profile adds where the GPU's time goes, kernel by kernel, and --memory-peak what lies in its memory at the peak.
"""

import argparse
import json
import os
import resource
import time
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
import torch.distributed as dist

from measuring.exchanged_bytes import Exchanged, counted_bytes
from measuring.kernel_profile import StepProfile, profiled_step
from measuring.peak_allocations import peak_of, peak_table, reserved_by_pool, start_noting, stop_noting
from measuring.profile_tables import profile_tables
from measuring.ranks import on_ranks
from measuring.timing import wait
from thermosplat.config import DensificationConfig, TrainConfig
from thermosplat.datasets.cameras import Camera
from thermosplat.datasets.capture import Capture, Frame, View
from thermosplat.distributed.team import Team
from thermosplat.runs.atomic_writes import write_text
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.thermal.radiometry import GREY, PixelScale
from thermosplat.training.trainer import Trainer
from training.step_parts import finer_part_of

FRAMES = 8
WARM_UP = FRAMES + 4
"""Steps before any is timed: those that run line by line, and the first ones of a CUDA graph."""

PROFILED = 10
"""Steps that are profiled."""


def random_capture(count: int, width: int, height: int) -> Capture:
    """Points that fill the view of cameras side by side, with images of noise."""
    random = np.random.default_rng(0)
    camera = Camera(float(width), float(width), width / 2, height / 2, width, height)

    def frame(number: int) -> Frame:
        viewmat = np.eye(4)
        viewmat[0, 3] = 0.05 * number
        image = random.integers(0, 256, (height, width, 3), dtype=np.uint8)
        heat = random.random((height, width, 1), dtype=np.float32)
        name = f"frame{number}"
        return Frame(
            name,
            {
                "rgb": View("rgb", name, Path(f"{name}.png"), camera, viewmat, image),
                "thermal": View("thermal", name, Path(f"{name}_t.png"), camera, viewmat, heat),
            },
        )

    points = random.uniform((-1.0, -0.8, 2.0), (1.0, 0.8, 6.0), (count, 3)).astype(np.float32)
    points[:, :2] *= 0.5 * points[:, 2:]
    frames = tuple(map(frame, range(FRAMES + 1)))
    return Capture(
        name="random",
        root=Path("random"),
        layout="rgbt-scenes",
        train=frames[1:],
        test=frames[:1],
        points=points,
        point_colors=random.integers(0, 256, (count, 3), dtype=np.uint8),
        scales={"rgb": PixelScale("photograph"), "thermal": PixelScale("scalar", GREY, (0.0, 1.0), "celsius")},
        spectra=dict(TrainConfig().spectra),
    )


def measured(rank: int, ranks: int, options: argparse.Namespace, count: int, folder: str) -> None:
    """One rank's steps; rank 0 writes the row."""
    on_cuda = options.device == "cuda"
    device = torch.device("cuda", rank) if on_cuda else torch.device("cpu")
    if not on_cuda:
        torch.set_num_threads(max((os.cpu_count() or 1) // ranks, 1))
    width, height = map(int, options.size.split("x"))
    config = TrainConfig(
        max_steps=10_000,
        batch_size=options.batch,
        device="cuda" if on_cuda else "cpu",
        tensorboard=False,
        log_every=10**9,
        densification=DensificationConfig(stop_step=0),
    )
    config = replace(config, sh_degree_interval=1, compile=on_cuda)
    capture, run = random_capture(count, width, height), RunDirectory(Path(folder) / "run")
    trainer: Trainer
    if on_cuda:
        torch.cuda.set_device(device)
    if options.memory_peak:
        start_noting()
    if ranks == 1:
        trainer = Trainer(config, capture, run)
    else:
        store = dist.FileStore(str(Path(folder) / "store"), ranks)
        backend = "cpu:gloo,cuda:nccl" if on_cuda else "gloo"
        dist.init_process_group(backend, store=store, rank=rank, world_size=ranks)
        trainer = Trainer(config, capture, run, team=Team(rank, ranks, device))

    def steps(number: int) -> float:
        wait(device)
        started = time.perf_counter()
        for _ in range(number):
            trainer.train_step()
        wait(device)
        return time.perf_counter() - started

    steps(WARM_UP)
    if on_cuda:
        torch.cuda.reset_peak_memory_stats(device)
    seconds = steps(options.steps)
    memory = reserved = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    if on_cuda:
        memory, reserved = torch.cuda.max_memory_allocated(device), torch.cuda.memory_reserved(device)
    if rank == 0 and (options.profile or options.memory_peak):  # should what comes now fail, this is known
        print(f"{1e3 * seconds / options.steps:.2f} ms per step, {memory / 1e9:.3f} GB, {reserved / 1e9:.3f} reserved.")
    profile = profiled_step(trainer.train_step, PROFILED, device, finer_part_of) if options.profile else None
    recordings, exchanged = trainer.steps.recordings, Exchanged()
    if ranks > 1:
        if recordings is not None:
            trainer.steps.recordings = None
            steps(1)
        with counted_bytes() as exchanged:
            steps(options.steps)
    trainer.steps.recordings = recordings
    peaks = peak_tables(trainer, device) if options.memory_peak else []
    of_rank = {
        "seconds": seconds,
        "memory": memory,
        "reserved": reserved,
        "bytes": exchanged.bytes,
        "exchange": exchanged.seconds,
        "profile": None if profile is None else asdict(profile),
        "peaks": peaks,
    }
    every: list[Any] = [of_rank]
    if ranks > 1:
        every = [None] * ranks
        dist.all_gather_object(every, of_rank)
        trainer.steps.forget()  # NCCL does not end as long as there are recordings of its exchanges
        dist.destroy_process_group()
    if rank == 0:
        (Path(folder) / "row.json").write_text(json.dumps(every))


def peak_tables(trainer: Trainer, device: torch.device) -> list[str]:
    """What lies in the device's memory at the peak of a step: line by line, and while it is recorded.

    Args:
        trainer: Whose steps; afterwards it runs them as before.
        device: Where.
    """
    step, recordings, tables = trainer.train_step, trainer.steps.recordings, []
    if recordings is not None:
        trainer.steps.recordings = None
        step()
        tables.append(peak_table("Peak of a step line by line", peak_of(step, device)))
        trainer.steps.recordings = recordings
        recordings.forget()
        tables.append(peak_table("Peak of recording a step", peak_of(step, device)))
    else:
        tables.append(peak_table("Peak of a step", peak_of(step, device)))
    tables += [
        f"Reserved {name}: {reserved / 1e6:.1f} MB, {allocated / 1e6:.1f} of them allocated between two steps.\n"
        for name, (reserved, allocated) in reserved_by_pool(device).items()
    ]
    stop_noting()
    return tables


def row(options: argparse.Namespace, count: int, ranks: int) -> dict[str, Any]:
    """What so many ranks reach with so many Gaussians."""
    with TemporaryDirectory() as folder:
        on_ranks(ranks, measured, ranks, options, count, folder)
        every = json.loads((Path(folder) / "row.json").read_text())
    slowest = max(of_rank["seconds"] for of_rank in every)
    sent = [of_rank["bytes"] / options.steps for of_rank in every]
    return {
        "gaussians": count,
        "ranks": ranks,
        "images_per_second": options.steps * options.batch / slowest,
        "step_ms": 1e3 * slowest / options.steps,
        "exchange_ms": 1e3 * max(of_rank["exchange"] for of_rank in every) / options.steps,
        "sent_mb": max(sent) / 1e6,
        "imbalance": max(sent) * len(sent) / sum(sent) if sum(sent) else 1.0,
        "memory_gb": max(of_rank["memory"] for of_rank in every) / 1e9,
        "reserved_gb": max(of_rank["reserved"] for of_rank in every) / 1e9,
        "profiles": [of_rank["profile"] for of_rank in every if of_rank["profile"] is not None],
        "peaks": [of_rank["peaks"] for of_rank in every],
    }


def markdown(rows: list[dict[str, Any]]) -> str:
    """The rows as a table, beside one process where that was measured."""
    alone = {found["gaussians"]: found for found in rows if found["ranks"] == 1}
    lines = [
        "| Gaussians | ranks | images/s | x one | step [ms] | exchange [ms] | sent per step [MB] | most / mean sent | "
        "memory per rank [GB] | of one | reserved per rank [GB] | of one |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for found in rows:
        one = alone.get(found["gaussians"])
        faster = f"{found['images_per_second'] / one['images_per_second']:.2f}" if one else ""
        smaller = f"{found['memory_gb'] / one['memory_gb']:.2f}" if one else ""
        narrower = f"{found['reserved_gb'] / one['reserved_gb']:.2f}" if one else ""
        lines.append(
            f"| {found['gaussians']:,} | {found['ranks']} | {found['images_per_second']:.2f} | {faster} | "
            f"{found['step_ms']:.1f} | {found['exchange_ms']:.1f} | {found['sent_mb']:.1f} | "
            f"{found['imbalance']:.2f} | {found['memory_gb']:.2f} | {smaller} | "
            f"{found['reserved_gb']:.2f} | {narrower} |"
        )
    return "\n".join(lines) + "\n"


def details(rows: list[dict[str, Any]], number: int) -> str:
    """What was profiled for a row, beside one process where that was measured; nothing where it was not asked for."""
    found = rows[number]
    ranks = found["ranks"]
    title = f"{found['gaussians']:,} Gaussians, {ranks} {'rank' if ranks == 1 else 'ranks'}"
    text = ""
    if found["profiles"]:
        alone = [row["profiles"][0] for row in rows if row["ranks"] == 1 and row["gaussians"] == found["gaussians"]]
        beside = StepProfile.of(alone[0]) if alone and ranks > 1 else None
        text += profile_tables(f"{title}: GPU time", list(map(StepProfile.of, found["profiles"])), beside)
    for rank, tables in enumerate(found["peaks"]):
        if tables:
            text += "\n".join([f"\n**{title}: memory of rank {rank}**\n", *tables])
    return text


def main() -> None:
    """Measure and print, a row at a time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ranks", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--counts", type=int, nargs="+", default=[1_000_000, 4_000_000], help="Gaussians")
    parser.add_argument("--size", default="1280x1024", help="WIDTHxHEIGHT of the images")
    parser.add_argument("--batch", type=int, default=2, help="frames of a step")
    parser.add_argument("--steps", type=int, default=30, help="that are timed")
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--json", type=Path, default=None, help="file to write")
    parser.add_argument("--markdown", type=Path, default=None, help="file to write the table to")
    parser.add_argument("--profile", action="store_true", help="add the GPU time of a step by kernel (CUDA only)")
    parser.add_argument("--memory-peak", action="store_true", help="add what is allocated at the peak (CUDA only)")
    options = parser.parse_args()
    if options.device == "cpu" and (options.profile or options.memory_peak):
        parser.error("--profile and --memory-peak look at a GPU's kernels and memory: they need --device cuda.")
    rows: list[dict[str, Any]] = []
    for count in options.counts:
        for ranks in options.ranks:
            rows.append(row(options, count, ranks))
            print(markdown(rows) + details(rows, len(rows) - 1), flush=True)
            if options.json is not None:
                write_text(options.json, json.dumps({"rows": rows, "options": vars(options)}, default=str))
            if options.markdown is not None:
                every = (details(rows, number) for number in range(len(rows)))
                write_text(options.markdown, markdown(rows) + "".join(every))


if __name__ == "__main__":
    main()
