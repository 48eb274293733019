"""How much quality does a scene keep with a share of its Gaussians?

    python benchmarks/bench_budget.py DATA... [--config thermosplat_plus] [--max-steps 30000] [--fine-tune 1000]
        [--budgets 0.01 0.05 0.25 1.0] [--time-limit 600] [--out results/budget] [--runs FOLDER...]

Trains each DATA once with its number of Gaussians fixed (or takes a finished run), then for every budget removes the
Gaussians that matter least to the training views, fine-tunes what is left, drops opacity offsets, latent channels and
spherical harmonics and rounds parameters as ``--budget auto`` does, and evaluates the held-out views. The budget 1.0 is
fine-tuned as long and keeps everything as float32: what the others are compared with. Writes budget.json, budget.md
and, where matplotlib is installed, budget.png. The same command goes on after an interruption: what budget.json holds
is not measured again.
"""

import argparse
import json
import math
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast

import cv2  # noqa: F401  (before pycolmap, see src/thermosplat/datasets/lens.py)

from thermosplat.config import AutoBudgetConfig, TrainConfig
from thermosplat.config.files import load_config
from thermosplat.config.run_schedule import in_steps
from thermosplat.datasets import load_capture
from thermosplat.datasets.capture import Capture
from thermosplat.method_matrix.cell_run import frames_per_second
from thermosplat.rasterizer.warp_start import start_warp
from thermosplat.runs.atomic_writes import write_atomically, write_text
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.spectra import label
from thermosplat.training.budget.pruning import least
from thermosplat.training.budget.tolerances import TOLERANCES
from thermosplat.training.session.resuming import newest_checkpoint
from thermosplat.training.trainer import Trainer

BUDGETS = (0.01, 0.02, 0.05, 0.1, 0.25, 0.5, 0.75, 1.0)
COLUMNS = {
    "budget": "{:.0%}",
    "num_gaussians": "{:,}",
    "model_bytes": "{:,}",
    "bytes_share": "{:.1%}",
}
PSNR, MILLISECONDS = "_psnr", "ms"
Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class Settings:
    """What a measurement depends on, beside scene and budget."""

    config: str
    """Preset or file; of finished runs, their folders."""
    max_steps: int | None
    data_factor: int
    fine_tune: int


class PrunedTrainer(Trainer):
    """Whose budget leaves out what is asked for, and nothing else."""

    tolerances = replace(TOLERANCES, offset_shrinkage=0.0, noise_floor=0.0, validation_views=0)


def measured(run: RunDirectory, capture: Capture, out: Path, budget: float, settings: Settings) -> dict[str, Any]:
    """Prunes a finished run to a share of its Gaussians, fine-tunes and evaluates it."""
    checkpoint = newest_checkpoint(run)
    before = in_steps(load_config(run.config_yaml))
    config = replace(
        before,
        max_steps=checkpoint.step + settings.fine_tune,
        eval_steps=(),
        save_steps=(),
        result_dir=str(out),
        budget="auto" if budget < 1.0 else "fixed",
        auto_budget=AutoBudgetConfig(prune_at=()),
        densification=replace(before.densification, stop_step=0),
    )
    trainer = PrunedTrainer(config, capture, RunDirectory.create(out, overwrite=True), checkpoint=checkpoint)
    if trainer.budget is not None:
        scores = trainer.budget.scores(trainer.sh_degree, trainer.budget.images(trainer.sh_degree))
        trainer.budget.remove(
            {name: least(values, round((1.0 - budget) * len(values))) for name, values in scores.items()}
        )
        trainer.budget.drop_offsets(trainer.sh_degree)
        trainer.budget.reduce_features(trainer.sh_degree)
    metrics = trainer.train()
    for path in trainer.run.ckpts.glob("*.pt"):
        path.unlink()
    rate = frames_per_second(trainer.model.eval(), capture, sh_degree=trainer.sh_degree)
    return {
        "budget": budget,
        "num_gaussians": metrics["num_gaussians"],
        "model_bytes": metrics["model_bytes"],
        **{f"{name}{PSNR}": (metrics[name] or {}).get("psnr") for name in metrics["spectra"]},
        MILLISECONDS: 1000.0 / rate,
        "opacity_offsets_kept": metrics["opacity_offsets_kept"],
        "feature_channels": metrics["feature_channels"],
    }


def measured_spectra(rows: Rows) -> list[str]:
    """The spectra of some measurements."""
    return list(dict.fromkeys(key.removesuffix(PSNR) for row in rows for key in row if key.endswith(PSNR)))


def table(rows: Rows) -> str:
    """The measurements of a scene as Markdown, the smallest budget first."""
    whole = next((row["model_bytes"] for row in rows if row["budget"] == 1.0), None)
    columns = COLUMNS | {f"{name}{PSNR}": "{:.2f}" for name in measured_spectra(rows)} | {MILLISECONDS: "{:.2f}"}
    lines = [" | ".join(["", *columns, ""]).strip(), "|" + "---|" * len(columns)]
    for row in sorted(rows, key=lambda row: cast(float, row["budget"])):
        shown = {**row, "bytes_share": None if whole is None else row["model_bytes"] / whole}
        cells = ["-" if shown.get(key) is None else form.format(shown[key]) for key, form in columns.items()]
        lines.append(" | ".join(["", *cells, ""]).strip())
    return "\n".join(lines) + "\n"


def plot(scenes: dict[str, Rows], path: Path) -> bool:
    """How far PSNR falls over Gaussians, bytes and milliseconds; whether matplotlib was there to draw it."""
    try:
        import matplotlib
    except ImportError:
        return False
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    quantities = {"num_gaussians": "Gaussians", "model_bytes": "model bytes", MILLISECONDS: "ms per frame, all spectra"}
    spectra = measured_spectra([row for rows in scenes.values() for row in rows])
    size = {"figsize": (13, 3.5 * len(spectra)), "sharex": "col", "sharey": "row", "squeeze": False}
    figure, grid = plt.subplots(len(spectra), len(quantities), layout="constrained", **size)
    for spectrum, axes in zip(spectra, grid, strict=True):
        axes[0].set_ylabel(f"held-out {label(spectrum)} PSNR\nover that of all Gaussians [dB]")
        for axis, key in zip(axes, quantities, strict=True):
            for name, rows in scenes.items():
                ordered = sorted(rows, key=lambda row: cast(float, row["budget"]))
                whole, values = ordered[-1], [row.get(f"{spectrum}{PSNR}") for row in ordered]
                if None not in values and whole["budget"] == 1.0:
                    axis.plot([row[key] for row in ordered], [v - values[-1] for v in values], "o-", label=name)
            axis.axhline(-0.1, color="grey", linewidth=0.8, linestyle="--")
            axis.set_xscale("linear" if key == MILLISECONDS else "log")
            axis.grid(alpha=0.3)
    for axis, text in zip(grid[-1], quantities.values(), strict=True):
        axis.set_xlabel(text)
    grid[0, 0].legend()
    write_atomically(path, lambda temporary: figure.savefig(temporary, dpi=130))
    return True


def trained(out: Path, data: str, options: argparse.Namespace, capture: Capture) -> RunDirectory:
    """A finished run of a capture in a folder: as it is there, gone on with, or made."""
    preset = in_steps(load_config(options.config))
    config: TrainConfig = replace(
        preset,
        data=data,
        max_steps=options.max_steps or preset.max_steps,
        data_factor=options.data_factor,
        device=options.device,
        result_dir=str(out),
        budget="fixed",
        eval_steps=(),
        save_steps=(),
    )
    run = RunDirectory(out)
    if run.metrics_json.is_file() and run.latest_checkpoint() and load_config(run.config_yaml) == config:
        return run
    run = RunDirectory.create(out, overwrite=True)
    Trainer(config, capture, run).train()
    return run


def main() -> None:
    """Measures every budget of every scene, writes the tables and the plot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", metavar="DATA", nargs="+")
    parser.add_argument("--config", default="thermosplat_plus", help="preset or YAML file to train with")
    parser.add_argument("--max-steps", type=int, help="steps of that training; default: the configuration's")
    parser.add_argument("--data-factor", type=int, default=1)
    parser.add_argument("--fine-tune", type=int, default=1000, metavar="STEPS", help="steps after pruning")
    parser.add_argument("--budgets", type=float, nargs="+", default=list(BUDGETS), metavar="SHARE")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--out", type=Path, default=Path("results/budget"))
    parser.add_argument("--runs", nargs="+", help="a finished run of each DATA, to take in place of training them")
    parser.add_argument(
        "--time-limit", type=float, default=math.inf, metavar="SECONDS", help="begin nothing after this time"
    )
    options = parser.parse_args()
    if options.runs is not None and len(options.runs) != len(options.data):
        parser.error(f"--runs: {len(options.data)} captures need as many runs, found {len(options.runs)}")
    started = time.perf_counter()
    start_warp()
    config = " ".join(options.runs) if options.runs else options.config
    settings = Settings(config, options.max_steps, options.data_factor, options.fine_tune)
    report: dict[str, Any] = {"settings": asdict(settings), "scenes": {}}
    path: Path = options.out / "budget.json"
    if path.is_file() and (found := json.loads(path.read_text()))["settings"] == report["settings"]:
        report = found
    scenes: dict[str, Rows] = report["scenes"]
    for index, data in enumerate(options.data):
        finished = RunDirectory.open(options.runs[index]) if options.runs else None
        base = load_config(finished.config_yaml if finished else options.config)
        factor = base.data_factor if finished else options.data_factor
        capture = load_capture(data, data_factor=factor, test_every=base.test_every, spectra=base.spectra)
        rows = scenes.setdefault(capture.name, [])
        folder: Path = options.out / capture.name
        for budget in sorted(set(options.budgets) - {row["budget"] for row in rows}, reverse=True):
            if time.perf_counter() - started > options.time_limit:
                break
            run = finished or trained(folder / "full", data, options, capture)
            rows.append(measured(run, capture, folder / f"budget_{round(1000 * budget):04d}", budget, settings))
            write_text(path, json.dumps(report, indent=2))
    text = "\n".join(f"{name}\n\n{table(rows)}" for name, rows in scenes.items() if rows)
    write_text(options.out / "budget.md", text)
    print(text)
    found = {name: rows for name, rows in scenes.items() if rows}
    if found and not plot(found, options.out / "budget.png"):
        print("No plot: pip install matplotlib.")


if __name__ == "__main__":
    main()
