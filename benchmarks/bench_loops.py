"""Do the captured, fused training loop and the plain one end at the same quality?

    python benchmarks/bench_loops.py DATA --seeds 1 2 3 --branch 15000 --at-once 3 --json loops.json
    python benchmarks/bench_loops.py DATA --seeds 1 2 3 4 5 6 --at-once 6 -- --max-steps 2500

Two trainings of one seed end some tenths of a dB apart on CUDA, as the order of sums does, which hides what a loop
changes. With ``--branch STEP`` every seed is trained once, and from its checkpoint at STEP the rest is trained twice
more, by the default loop again and with ``--no-graph --no-compile``: trainings that began the same scatter less.
Without it both loops train every seed from the start. What follows ``--`` are flags of thermosplat-train. Several
trainings share a GPU, so nothing here says anything of time.
"""

import argparse
import json
import math
import shlex
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

from thermosplat.method_matrix.cell_result import write_json
from thermosplat.method_matrix.processes import choose_devices
from thermosplat.runs.run_directory import RunDirectory
from training.command import apart
from training.trainings import Trainings

Row = dict[str, Any]


def measured(trainings: Trainings, command: Sequence[str], seed: int, branch: int, folder: Path) -> Row:
    """The PSNR that each loop ends with.

    Args:
        trainings: where they run.
        command: arguments of thermosplat-train, the capture first.
        seed: of all of them.
        branch: steps that they have in common; 0: none.
        folder: where the runs go.
    """
    words = [*command, "--seed", str(seed)]
    begun, plain = folder / "default", folder / "plain"
    save = ["--save-steps", str(branch)] if branch > 0 else []
    row: Row = {"seed": seed, "default": trainings.train(begun, *words, *save, "--result-dir", str(begun))}
    if branch == 0:
        row["plain"] = trainings.train(plain, *words, "--no-graph", "--no-compile", "--result-dir", str(plain))
        return row
    for loop in ("again", "plain"):
        run = RunDirectory(Path(shutil.copytree(begun, folder / loop)))
        if loop == "plain":  # in the file: a run goes on with the settings that it was begun with
            run.write_config(replace(run.read_config(), graph=False, compile=False))
        run.metrics_json.unlink()
        for path in run.checkpoints():
            if path != run.checkpoint(branch):
                path.unlink()
        row[loop] = trainings.train(run.path, "--resume", str(run.path))
    return row


def difference(rows: Sequence[Row], loop: str, spectrum: str) -> tuple[float, float]:
    """Mean over seeds of a loop's PSNR minus that of the default loop's other runs, and its standard error [dB]."""
    others = [other for other in ("default", "again") if other in rows[0] and other != loop]
    found = [row[loop][spectrum] - statistics.mean(row[other][spectrum] for other in others) for row in rows]
    spread = statistics.stdev(found) if len(found) > 1 else math.nan
    return statistics.mean(found), spread / math.sqrt(len(found))


def table(rows: Sequence[Row]) -> str:
    """The rows as Markdown, and below them how far the loops end from the default's mean."""
    loops = [loop for loop in ("default", "again", "plain") if loop in rows[0]]
    columns = [(loop, spectrum) for spectrum in rows[0]["default"] for loop in loops]
    lines = ["| seed | " + " | ".join(f"{spectrum}, {loop}" for loop, spectrum in columns) + " |"]
    lines.append("|---" * (len(columns) + 1) + "|")
    for row in sorted(rows, key=lambda row: int(row["seed"])):
        cells = [f"{row[loop][spectrum]:.3f}" for loop, spectrum in columns]
        lines.append(f"| {row['seed']} | " + " | ".join(cells) + " |")
    lines.append("")
    for loop, spectrum in columns:
        if loop != "default":
            mean, error = difference(rows, loop, spectrum)
            lines.append(f"{spectrum}, {loop} minus default: {mean:+.3f} ± {error:.3f} dB over {len(rows)} seeds")
    return "\n".join(lines) + "\n"


def parse(words: list[str]) -> tuple[argparse.Namespace, list[str]]:
    """The script's own options, and the flags of thermosplat-train after ``--``."""
    words, flags = apart(words)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", help="folder of a capture, or sample")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--branch", type=int, default=0, help="steps in common; default 0")
    parser.add_argument("--devices", nargs="+", default=[], help="default every CUDA device, or the CPU")
    parser.add_argument("--at-once", type=int, default=1, help="trainings a device")
    parser.add_argument("--time-limit", type=float, default=math.inf, help="begin no seed after so long [s]")
    parser.add_argument("--json", type=Path, default=None, help="file to write")
    return parser.parse_args(words), flags


def main(words: list[str] | None = None) -> int:
    """Trains every seed in every loop; returns 1 if a training failed."""
    options, flags = parse(sys.argv[1:] if words is None else words)
    trainings = Trainings(choose_devices(options.devices), options.at_once)
    rows: list[Row] = []
    failed = False
    started = time.monotonic()

    def one(seed: int) -> Row | None:
        if time.monotonic() - started > options.time_limit:
            return None
        folder = root / str(seed)
        try:
            return measured(trainings, [options.data, *flags], seed, options.branch, folder)
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(trainings.count) as threads:
        root = Path(name)
        for future in [threads.submit(one, seed) for seed in options.seeds]:
            try:
                row = future.result()
            except RuntimeError as error:
                print(error, file=sys.stderr, flush=True)
                failed = True
                continue
            if row is None:
                continue
            rows.append(row)
            print(json.dumps(row), flush=True)
            if options.json is not None:
                report = {"command": shlex.join(["python", "benchmarks/bench_loops.py", *sys.argv[1:]])}
                write_json(options.json, report | {"date": time.strftime("%Y-%m-%d"), "rows": rows})
    if rows:
        print(table(rows))
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
