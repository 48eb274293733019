"""How much quality does a scene keep with a share of its Gaussians?

    python benchmarks/bench_budget.py DATA [--config thermosplat] [--max-steps 7000] [--fine-tune 1000]
        [--budgets 0.01 0.05 0.25 1.0] [--prune-by weights] [--out results/budget] [--run FOLDER]

Trains DATA once (or takes a finished run), then for every budget removes the Gaussians that contribute least to the
training views, fine-tunes what is left with its number fixed, drops the thermal offsets and spherical harmonics that do
next to nothing (as ``--budget auto`` does), and evaluates the held-out views. The budget 1.0 is fine-tuned as long and
keeps everything: what the others are compared with. Writes budget.json, budget.md and, where matplotlib is installed,
budget.png.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2  # noqa: F401  (before pycolmap: see docs/troubleshooting.md)

from thermosplat.cli.warp_start import start_warp
from thermosplat.config import AutoBudgetConfig, TrainConfig
from thermosplat.config_files import load_config
from thermosplat.datasets import load_capture
from thermosplat.datasets.capture import Capture
from thermosplat.evaluation import evaluate
from thermosplat.method_matrix.render_speed import frames_per_second
from thermosplat.run_directory import RunDirectory
from thermosplat.training.contributions import contributions, least, prune_sets
from thermosplat.training.offset_shrinkage import drop_offsets
from thermosplat.training.resuming import newest_checkpoint
from thermosplat.training.sh_bands import drop_bands
from thermosplat.training.trainer import Trainer

BUDGETS = (0.01, 0.02, 0.05, 0.1, 0.25, 0.5, 0.75, 1.0)
COLUMNS = {
    "budget": "{:.0%}",
    "num_gaussians": "{:,}",
    "model_bytes": "{:,}",
    "rgb_psnr": "{:.2f}",
    "thermal_psnr": "{:.2f}",
    "ms": "{:.2f}",
}


def measured(
    run: RunDirectory, capture: Capture, out: Path, budget: float, fine_tune: int, *, squared: bool
) -> dict[str, Any]:
    """Prunes a finished run to a share of its Gaussians, fine-tunes and evaluates it."""
    checkpoint = newest_checkpoint(run)
    before = load_config(run.config_yaml)
    config = replace(
        before,
        max_steps=checkpoint["step"] + fine_tune,
        eval_steps=(),
        save_steps=(),
        result_dir=str(out),
        budget="fixed",
        densification=replace(before.densification, enabled=False),
    )
    trainer = Trainer(config, capture, RunDirectory.create(out, overwrite=True), checkpoint=checkpoint)
    frames = [trainer.frames[index] for index in range(len(trainer.frames))]
    state, settings = trainer.state, AutoBudgetConfig()
    if budget < 1.0:
        shares = contributions(trainer.model, frames, squared=squared)
        removed = {name: least(values, round((1.0 - budget) * len(values))) for name, values in shares.items()}
        prune_sets(state.gaussian_sets, state.optimizers, removed)
        for name, gaussians in state.gaussian_sets.items():
            state.strategies[name].forget(len(gaussians))
            drop_offsets(gaussians, state.optimizers[name], settings.offset_tolerance)
        state.offsets_dropped = True
    trainer.train()
    if budget < 1.0:
        drop_bands(trainer.model, frames, trainer.sh_degree, settings.sh_tolerance)
    metrics = evaluate(trainer.model, capture, sh_degree=trainer.sh_degree, device=trainer.device)
    for path in trainer.run.ckpts.glob("*.pt"):
        path.unlink()
    rate = frames_per_second(trainer.model.eval(), capture, sh_degree=trainer.sh_degree, device=trainer.device)
    return {
        "budget": budget,
        "num_gaussians": trainer.model.num_gaussians,
        "model_bytes": trainer.model.num_bytes,
        "rgb_psnr": (metrics["rgb"] or {}).get("psnr"),
        "thermal_psnr": (metrics["thermal"] or {}).get("psnr"),
        "ms": 1000.0 / rate,
        "thermal_offsets_kept": trainer.model.offsets_kept,
    }


def table(rows: list[dict[str, Any]]) -> str:
    """The measurements as Markdown."""
    lines = [" | ".join(["", *COLUMNS, ""]).strip(), "|" + "---|" * len(COLUMNS)]
    for row in rows:
        cells = ["-" if row[key] is None else form.format(row[key]) for key, form in COLUMNS.items()]
        lines.append(" | ".join(["", *cells, ""]).strip())
    return "\n".join(lines) + "\n"


def plot(rows: list[dict[str, Any]], title: str, path: Path) -> bool:
    """PSNR over Gaussians, bytes and milliseconds; whether matplotlib was there to draw it."""
    try:
        import matplotlib
    except ImportError:
        return False
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    quantities = {"num_gaussians": "Gaussians", "model_bytes": "model bytes", "ms": "ms a frame, both spectra"}
    modalities = [name for name in ("rgb", "thermal") if rows[0][f"{name}_psnr"] is not None]
    shape = (len(modalities), len(quantities))
    figure, grid = plt.subplots(*shape, figsize=(13, 3 * shape[0]), sharey="row", squeeze=False, layout="constrained")
    for modality, axes in zip(modalities, grid):
        axes[0].set_ylabel(f"held-out {modality} PSNR [dB]")
        for axis, (key, label) in zip(axes, quantities.items()):
            axis.plot([row[key] for row in rows], [row[f"{modality}_psnr"] for row in rows], "o-")
            axis.set_xscale("linear" if key == "ms" else "log")
            axis.set_xlabel(label)
            axis.grid(alpha=0.3)
    figure.suptitle(title)
    figure.savefig(path, dpi=130)
    return True


def trained(options: argparse.Namespace, capture: Capture) -> RunDirectory:
    """The run to start from."""
    if options.run is not None:
        return RunDirectory.open(options.run)
    preset = load_config(options.config)
    config: TrainConfig = replace(
        preset,
        data=options.data,
        max_steps=options.max_steps or preset.max_steps,
        data_factor=options.data_factor,
        device=options.device,
        result_dir=str(options.out / "full"),
        eval_steps=(),
        save_steps=(),
    )
    run = RunDirectory.create(options.out / "full", overwrite=True)
    Trainer(config, capture, run).train()
    return run


def main() -> None:
    """Trains once, measures every budget, writes the table and the plot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", metavar="DATA")
    parser.add_argument("--config", default="thermosplat", help="preset or YAML file to train with")
    parser.add_argument("--max-steps", type=int, help="steps of that training; default: the configuration's")
    parser.add_argument("--data-factor", type=int, default=1)
    parser.add_argument("--fine-tune", type=int, default=1000, metavar="STEPS", help="steps after pruning")
    parser.add_argument("--budgets", type=float, nargs="+", default=list(BUDGETS), metavar="SHARE")
    parser.add_argument("--prune-by", choices=("weights", "squares"), default="squares")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--out", type=Path, default=Path("results/budget"))
    parser.add_argument("--run", help="a finished run of DATA to take in place of training one")
    options = parser.parse_args()
    start_warp()
    base = load_config(RunDirectory.open(options.run).config_yaml) if options.run else load_config(options.config)
    factor = base.data_factor if options.run else options.data_factor
    capture = load_capture(options.data, data_factor=factor, test_every=base.test_every, thermal=base.thermal)
    run = trained(options, capture)
    rows = []
    for budget in sorted(options.budgets):
        folder = options.out / f"budget_{round(1000 * budget):04d}"
        squared = options.prune_by == "squares"
        rows.append(measured(run, capture, folder, budget, options.fine_tune, squared=squared))
        (options.out / "budget.json").write_text(json.dumps({"scene": capture.name, "rows": rows}, indent=2))
    (options.out / "budget.md").write_text(table(rows))
    print(table(rows))
    if not plot(rows, f"{capture.name}: {base.config}", options.out / "budget.png"):
        print("No plot: pip install matplotlib.")


if __name__ == "__main__":
    main()
