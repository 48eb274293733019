"""thermosplat-benchmark: methods times scenes, trained, measured and put into tables.

thermosplat-benchmark data/Dimsum data/Truck --methods baselines thermosplat ablations --out results/matrix
"""

import math
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from thermosplat.cli.command_line import check_ranges
from thermosplat.cli.host_settings import importing
from thermosplat.cli.program import program
from thermosplat.config.run_schedule import run_schedule
from thermosplat.errors import UserError
from thermosplat.method_matrix.cells import parse_methods, parse_scenes
from thermosplat.method_matrix.overrides import parse_overrides
from thermosplat.method_matrix.published_scenes import expand_collections
from thermosplat.method_matrix.shards import parse_shard

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermosplat.method_matrix.cells import Cell
    from thermosplat.method_matrix.matrix import Matrix


@dataclass(frozen=True)
class BenchmarkArguments:
    """Train and evaluate methods on scenes: results.json, tables as in ThermoSplat's paper, comparison sheets.

    A finished cell (scene, method, seed) is not made again, an interrupted one is gone on with: after any interruption
    the same command continues. Held-out views are looked at once, at the end of a training.

    Examples:
      thermosplat-benchmark data/Dimsum data/Truck --out results/matrix
      thermosplat-benchmark sample --methods 3dgs thermosplat --max-steps 500 --out results/quick
      thermosplat-benchmark rgbt-scenes=data/RGBT-Scenes --methods baselines thermosplat ablations --out results/paper
      thermosplat-benchmark data/Truck --set 3dgs:densification.max_gaussians=200000 --time-limit 3000
      thermosplat-benchmark data/Dimsum data/Truck --shard 2/8 --out /shared/matrix
      thermosplat-benchmark --out results/matrix --merge from_another_machine
    """

    scenes: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SCENES")] = ()
    """Folders of captures, or "sample"; NAME=FOLDER for another name in the tables. rgbt-scenes=FOLDER and
    thermoscenes=FOLDER stand for all scenes of these collections. None: tables of what is there."""
    methods: tuple[str, ...] = ("baselines", "thermosplat")
    """Presets or YAML files; "baselines" and "ablations" stand for all presets of that folder."""
    out: str = "results/benchmark"
    """Folder for everything: one run folder per cell (scene/method/seed_42), tables and sheets."""
    max_steps: int | None = None
    """Shorten the trainings: steps of a method that has 30,000, others in proportion. None: as each method has it."""
    seeds: tuple[int, ...] = (42,)
    """Seeds; with several, tables show mean ± standard deviation."""
    devices: tuple[str, ...] = ()
    """"cpu", "cuda:0", "cuda:1", ...: a process on each. None given: all CUDA devices, or the CPU without any."""
    gpus: int | None = None
    """Use so many CUDA devices, a process on each, in place of all."""
    data_factor: int = 1
    """Divide the images' width and height by this."""
    overrides: Annotated[tuple[str, ...], tyro.conf.arg(name="set", metavar="[CELLS:]FIELD=VALUE")] = ()
    """Settings other than the presets', of every cell or of a method, a scene or scene/method:
    densification.max_gaussians=200000, or 3dgs:densification.max_gaussians=200000."""
    shard: str | None = None
    """Make one part of the cells: 2/8 is the second of eight, each of which another host makes. With one --out on a
    shared disk the tables hold what all have made so far; elsewhere --merge joins the folders."""
    time_limit: float | None = None
    """Seconds after which no further cell starts; those in work are finished. The same command then goes on."""
    save_every: int = 5000
    """Steps between checkpoints, from which a cell goes on after a crash; 0: only when interrupted, and at the end."""
    keep_checkpoints: bool = True
    """Keep the last checkpoint of a finished cell (--no-keep-checkpoints: numbers, pictures and PLYs are enough)."""
    lpips_weights: str | None = None
    """Folder or file with LPIPS backbone weights, as for thermosplat-train."""
    merge: tuple[str, ...] = ()
    """Cells made elsewhere: --out folders, run folders, or results.json files. They count as finished."""
    debug: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Show the traceback of an error."""


def _benchmark(arguments: BenchmarkArguments) -> int:
    with importing():
        from thermosplat.method_matrix.processes import Job, choose_devices, run_jobs
        from thermosplat.method_matrix.report import write_report
        from thermosplat.method_matrix.results import Results

    shard = parse_shard(arguments.shard)
    matrix, merged = _matrix(arguments), [Path(folder) for folder in arguments.merge]
    if not matrix.scenes and not merged and not matrix.out.is_dir():
        raise UserError("No scene given.", "Name captures: thermosplat-benchmark data/Dimsum data/Truck --out FOLDER.")
    if matrix.out.exists() and not matrix.out.is_dir():
        raise UserError(f"{matrix.out} is a file; a matrix needs a folder.", "Give another --out.")
    finished = Results.collect(matrix.out, merged).cells
    cells = shard.of(matrix.cells())
    missing = [cell for cell in matrix.missing(finished) if cell in set(cells)]
    devices = choose_devices(arguments.devices, arguments.gpus) if missing else []
    if len(devices) > 1:  # one device takes as long in any order, and scene by scene its tables are complete earlier
        missing = matrix.longest_first(missing, finished)
    jobs = [matrix.job(cell) for cell in missing]
    failed: list[str] = []
    left: list[Job] = []
    ended = len(cells) - len(jobs)

    def started(job: Job, device: str) -> None:
        print(f"{job.title}: starts on {device}, log in {job.log}", flush=True)

    def done(job: Job, device: str, code: int) -> None:
        nonlocal ended
        ended += 1
        if code:
            failed.append(f"{job.title} (exit code {code}, log in {job.log}): {job.reason(code)}")
        outcome = f"failed: {job.reason(code)}" if code else "finished"
        print(f"{job.title}: {outcome} ({ended} of {len(cells)})", flush=True)
        if not code:
            try:
                write_report(matrix.out, merged)  # at once: the machine may go before the matrix is complete
            except UserError as error:  # said again at the end; the other cells go on
                print(f"The tables cannot be written now: {error}", flush=True)

    if jobs:
        print(
            f"{_cells(len(cells))}, {len(cells) - len(jobs)} of them finished. Steps: {_steps(matrix, missing)}",
            flush=True,
        )
        try:
            left = run_jobs(jobs, devices, started=started, done=done, time_limit=arguments.time_limit)
        except KeyboardInterrupt:
            print("Stopped; what was begun is saved. The same command goes on.", flush=True)
            raise
    if left:
        print(f"Time is up: {len(left)} of {_cells(len(cells))} not begun. The same command goes on.", flush=True)
    if finished or len(failed) + len(left) < len(jobs) or not jobs:
        for table in write_report(matrix.out, merged):
            for line in ("", table.title, "", *table.markdown().splitlines()):
                print(line)
        print()
        print(f"Results in {matrix.out}: results.json, per_view.csv, tables.md, .csv, .tex and sheets/")
        if (matrix.out / "regions.md").is_file():
            print("Errors by region: regions.md, .csv and .tex there")
    if failed:
        for line in failed:
            print(line)
        raise UserError(f"{len(failed)} of {_cells(len(cells))} failed.", "The same command tries again.")
    return 0


def _cells(count: int) -> str:
    return f"{count} cell{'' if count == 1 else 's'}"


def _steps(matrix: "Matrix", cells: "Sequence[Cell]") -> str:
    """Steps of the methods: --max-steps is that of a method with 30,000."""
    steps: dict[str, list[int]] = {}
    for cell in cells:
        steps.setdefault(cell.method, []).append(run_schedule(matrix.config(cell)).max_steps)
    ranges = {method: (min(numbers), max(numbers)) for method, numbers in steps.items()}
    return ", ".join(
        f"{method} {least:,}" + (f" to {most:,}" if most > least else "") for method, (least, most) in ranges.items()
    )


def _matrix(arguments: BenchmarkArguments) -> "Matrix":
    most = 100_000_000
    positive = dict.fromkeys(("max_steps", "data_factor", "gpus"), (1, most))
    check_ranges(arguments, **positive, save_every=(0, most), time_limit=(0, math.inf))
    if not arguments.seeds or min(arguments.seeds) < 0 or len(set(arguments.seeds)) < len(arguments.seeds):
        raise UserError(f"--seeds must be different whole numbers from 0 on, found {list(arguments.seeds)}.")
    words, notes = expand_collections(arguments.scenes)
    for note in notes:
        print(note, flush=True)
    scenes, methods = parse_scenes(words), parse_methods(arguments.methods)
    from thermosplat.method_matrix.matrix import Matrix

    return Matrix(
        out=Path(os.path.expanduser(arguments.out)),
        scenes=scenes,
        methods=methods,
        seeds=arguments.seeds,
        max_steps=arguments.max_steps,
        save_every=arguments.save_every,
        data_factor=arguments.data_factor,
        overrides=parse_overrides(arguments.overrides, [scene.name for scene in scenes], methods),
        lpips_weights=arguments.lpips_weights,
        keep_checkpoints=arguments.keep_checkpoints,
    )


main = program(BenchmarkArguments, _benchmark, prog="thermosplat-benchmark")

if __name__ == "__main__":
    sys.exit(main())
