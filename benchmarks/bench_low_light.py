"""What becomes of photographs that are noise: do trainings end at their best, and do they find the right size?

    python benchmarks/bench_low_light.py desk lab yard --electrons 30 140 600 --at-once 4 --out results/low-light
    python benchmarks/bench_low_light.py desk --settings "thermosplat --budget auto" --grid thermosplat_plus
    python benchmarks/bench_low_light.py desk --shrink 4 --electrons 30 --every 500 -- --max-steps 6000

Makes low-light copies of each DATA (scenes/low_light_capture.py), trains every setting on each and on the capture as it
is, evaluates the held-out views every ``--every`` steps, and says for each spectrum where the run ended and where it
was best. A setting is a preset, with flags of thermosplat-train behind it. ``--grid PRESET`` adds fixed choices of
steps and Gaussians of that preset, all its schedules in proportion, on each low-light copy, and on the captures as they
are where ``--electrons`` names no light. Their best is what a training that finds them itself is to be compared with.
The model of a setting that was trained on the capture as it is is evaluated on the low-light copies too: its error and
their noise together are what can be reached. What follows ``--`` are flags for all trainings.

Writes low_light.json and low_light.md. The same command goes on after an interruption: what low_light.json holds is not
measured again.
"""

import argparse
import json
import math
import shlex
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from scenes.low_light_capture import low_light_copy
from thermosplat.config.files import load_config
from thermosplat.method_matrix.cell_result import write_json
from thermosplat.method_matrix.processes import choose_devices
from thermosplat.runs.atomic_writes import write_text
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.spectra import label
from training.command import apart
from training.trainings import Trainings

SETTINGS = ("thermosplat", "thermosplat --budget auto", "thermosplat_plus")
STEPS, GAUSSIANS = (3_000, 7_000, 15_000, 30_000), (30_000, 60_000, 150_000, 300_000)
LIGHT = "as it is"
PSNRs = dict[str, float]


@dataclass(frozen=True)
class Row:
    """What a training came to."""

    capture: str
    light: str
    """Electrons at white of the photographs that were trained on, or ``LIGHT``."""
    setting: str
    seed: int
    in_grid: bool
    final: PSNRs
    """Held-out PSNR by spectrum after the last step [dB]."""
    best: PSNRs
    """The highest one of all evaluations, of each spectrum by itself."""
    best_steps: dict[str, int]
    num_gaussians: int
    model_bytes: int
    on_copies: dict[str, PSNRs]
    """Of a model of the capture as it is: its held-out PSNR on each low-light copy, by ``light``."""


@dataclass(frozen=True)
class Cell:
    """A training to be done."""

    capture: str
    light: str
    setting: str
    seed: int
    in_grid: bool = False


def cells(options: argparse.Namespace) -> Iterator[Cell]:
    """All trainings that were asked for, those of the captures as they are first."""
    grid = [
        f"{preset} --budget fixed --steps-scaler {scaler} --densification.max-gaussians {count}"
        for preset in options.grid
        for scaler in [steps / load_config(preset).max_steps for steps in options.grid_steps]
        for count in options.grid_gaussians
    ]
    lights = [f"{electrons:g}" for electrons in options.electrons]
    if not options.dark_only:
        lights.insert(0, LIGHT)
    for light in lights:
        for data in options.data:
            for seed in options.seeds:
                for setting in options.settings:
                    yield Cell(data.name, light, setting, seed)
                for setting in grid if light != LIGHT or not options.electrons else ():
                    yield Cell(data.name, light, setting, seed, in_grid=True)


def measured(cell: Cell, trainings: Trainings, options: argparse.Namespace, flags: Sequence[str]) -> Row:
    """Trains, and reads what the run says of itself."""
    captures, folder = options.out / "captures", options.out / "runs" / _file_name(cell)
    preset, *own = shlex.split(cell.setting)
    words = [*flags, *own, "--seed", str(cell.seed)]
    if not cell.in_grid:
        steps = _steps(preset, words)
        words += ["--eval-steps", *map(str, range(options.every, steps + 1, options.every))]
    words += ["--save-steps", "--no-tensorboard", "--overwrite", "--result-dir", str(folder)]
    trainings.run("train", str(captures / cell.light / cell.capture), "--config", preset, *words)
    run = RunDirectory(folder)
    on_copies = {}
    for electrons in options.electrons if cell.light == LIGHT else ():
        copy = captures / f"{electrons:g}" / cell.capture
        trainings.run("evaluate", str(folder), "--data", str(copy))
        (found,) = run.stats.glob("eval_*.json")
        on_copies[f"{electrons:g}"] = _psnrs(json.loads(found.read_text()))
        found.unlink()
    row = read_run(cell, run, on_copies)
    shutil.rmtree(folder)
    return row


def read_run(cell: Cell, run: RunDirectory, on_copies: dict[str, PSNRs]) -> Row:
    """What a finished run says of itself: its evaluations lie in ``stats``, the last one in metrics.json."""
    metrics = json.loads(run.metrics_json.read_text())
    final = _psnrs(metrics)
    best, best_steps = dict(final), dict.fromkeys(final, int(metrics["steps"]))
    for path in sorted(run.stats.glob("step_*.json")):
        for name, value in _psnrs(json.loads(path.read_text())).items():
            if value > best[name]:
                best[name], best_steps[name] = value, int(path.stem.removeprefix("step_"))
    return Row(
        **asdict(cell),
        final=final,
        best=best,
        best_steps=best_steps,
        num_gaussians=metrics["num_gaussians"],
        model_bytes=metrics["model_bytes"],
        on_copies=on_copies,
    )


def table(rows: Sequence[Row], ceilings: dict[str, dict[str, PSNRs]]) -> str:
    """The rows as Markdown, a table for each capture and light.

    Args:
        rows: What was measured.
        ceilings: PSNR at which only noise is left, by capture, light and spectrum [dB].
    """
    parts = []
    for capture, light in dict.fromkeys((row.capture, row.light) for row in rows):
        here = [row for row in rows if (row.capture, row.light) == (capture, light)]
        spectra = list(here[0].final)
        grid = [row for row in here if row.in_grid]
        found = ceilings.get(capture, {}).get(light, {})
        known = ", ".join(f"{label(name)} {value:.2f} dB" for name, value in found.items())
        of_light = light if light == LIGHT else f"{light} electrons at white"
        parts.append(f"{capture}, {of_light}{f'; only noise is left at {known}' if known else ''}\n")
        columns = [f"{label(name)} {what}" for name in spectra for what in ("final", "best (step)", "best of grid")]
        parts.append("| " + " | ".join(["setting", "seed", *columns, "Gaussians", "MB"]) + " |")
        parts.append("|---" * (len(columns) + 4) + "|")
        for row in (row for row in here if not row.in_grid):
            cells = [f"{row.setting}", f"{row.seed}"]
            for name in spectra:
                of_grid = f"{max(other.final[name] for other in grid):.2f}" if grid else "-"
                cells += [f"{row.final[name]:.2f}", f"{row.best[name]:.2f} ({row.best_steps[name]:,})", of_grid]
            parts.append("| " + " | ".join([*cells, f"{row.num_gaussians:,}", f"{row.model_bytes / 1e6:.1f}"]) + " |")
        for row in rows:
            if row.capture == capture and light in row.on_copies:
                scores = " / ".join(f"{value:.2f}" for value in row.on_copies[light].values())
                parts.append(f"\nTrained in the light, on these held-out views: {row.setting}, {row.seed}: {scores}")
        parts.append("")
    return "\n".join(parts)


def _psnrs(evaluation: dict[str, Any]) -> PSNRs:
    return {name: evaluation[name]["psnr"] for name in evaluation["spectra"] if evaluation[name]}


def _steps(preset: str, words: Sequence[str]) -> int:
    """Steps of a training with these flags."""
    if "--max-steps" in words:
        return int(words[len(words) - 1 - words[::-1].index("--max-steps") + 1])
    return load_config(preset).max_steps


def _file_name(cell: Cell) -> str:
    """A name for a training's folder."""
    words = f"{cell.capture} {cell.light} {cell.setting} {cell.seed}"
    return "".join(letter if letter.isalnum() or letter in "._" else "-" for letter in words)


def parse(words: list[str]) -> tuple[argparse.Namespace, list[str]]:
    """The script's own options, and the flags of thermosplat-train after ``--``."""
    words, flags = apart(words)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="+", help="folders of captures")
    parser.add_argument("--electrons", type=float, nargs="*", default=[30.0, 140.0, 600.0], help="at white")
    parser.add_argument("--dark-only", action="store_true", help="do not train on the captures as they are")
    parser.add_argument("--shrink", type=int, default=1, help="divide images by this before they are darkened")
    parser.add_argument("--settings", nargs="*", default=list(SETTINGS), help="presets, each with flags behind it")
    parser.add_argument("--grid", nargs="*", default=[], metavar="PRESET", help="presets to train with fixed choices")
    parser.add_argument("--grid-steps", type=int, nargs="+", default=list(STEPS))
    parser.add_argument("--grid-gaussians", type=int, nargs="+", default=list(GAUSSIANS))
    parser.add_argument("--every", type=int, default=1000, help="steps between evaluations")
    parser.add_argument("--seeds", type=int, nargs="+", default=[42])
    parser.add_argument("--devices", nargs="+", default=[], help="default every CUDA device, or the CPU")
    parser.add_argument("--at-once", type=int, default=1, help="trainings a device")
    parser.add_argument("--time-limit", type=float, default=math.inf, help="begin no training after so long [s]")
    parser.add_argument("--out", type=Path, default=Path("results/low-light"))
    return parser.parse_args(words), flags


def main(words: list[str] | None = None) -> int:
    """Makes the copies, trains what has not been measured yet; returns 1 if a training failed."""
    options, flags = parse(sys.argv[1:] if words is None else words)
    started = time.monotonic()
    path: Path = options.out / "low_light.json"
    settings = {"flags": flags, "shrink": options.shrink, "every": options.every}
    report: dict[str, Any] = {"settings": settings, "ceilings": {}, "rows": []}
    if path.is_file() and (found := json.loads(path.read_text()))["settings"] == settings:
        report = found
    for data in options.data:
        for electrons in (None, *options.electrons):
            light = LIGHT if electrons is None else f"{electrons:g}"
            copy = options.out / "captures" / light / data.name
            ceilings = low_light_copy(data, copy, electrons, shrink=options.shrink)
            report["ceilings"].setdefault(data.name, {})[light] = ceilings
    rows = [Row(**row) for row in report["rows"]]
    done = {Cell(row.capture, row.light, row.setting, row.seed, row.in_grid) for row in rows}
    trainings = Trainings(choose_devices(options.devices), options.at_once)
    failed = False

    def one(cell: Cell) -> Row | None:
        late = time.monotonic() - started > options.time_limit
        return None if late else measured(cell, trainings, options, flags)

    with ThreadPoolExecutor(trainings.count) as threads:
        for future in [threads.submit(one, cell) for cell in cells(options) if cell not in done]:
            try:
                row = future.result()
            except RuntimeError as error:
                print(error, file=sys.stderr, flush=True)
                failed = True
                continue
            if row is not None:
                rows.append(row)
                print(json.dumps(asdict(row)), flush=True)
                write_json(path, report | {"rows": [asdict(row) for row in rows]})
                write_text(options.out / "low_light.md", table(rows, report["ceilings"]))
    print(table(rows, report["ceilings"]))
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
