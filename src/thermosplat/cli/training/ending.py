"""After a training, on one device or several: what was made, and where it lies."""

import shlex
from typing import TYPE_CHECKING, Any

from thermosplat.spectra import label

if TYPE_CHECKING:
    from thermosplat.training.trainer import Trainer


def say_what_and_where(trainer: "Trainer", metrics: dict[str, Any]) -> None:
    """How large the model is, with what a budget has left of it, and what the run left behind."""
    from thermosplat.evaluation.held_out_poses import unrefined_sentences
    from thermosplat.evaluation.results_page import write_results_page
    from thermosplat.refinement.camera_report import correction_sentences

    size = [f"{metrics['num_gaussians']:,} Gaussians"]
    if trainer.budget is not None and metrics["feature_channels"] is not None:
        size.append(f"{metrics['feature_channels']} of {trainer.config.model.feature_dim} latent channels")
    for name, kept in metrics["opacity_offsets_kept"].items() if trainer.budget is not None else ():
        size.append(f"{kept:.0%} of the {label(name)} offsets")
    print(f"Model: {', '.join(size)}; {metrics['model_bytes'] / 1e6:.1f} MB.")
    for name, found in metrics["formations"].items():
        if "point_spread" in found:
            print(f"Blur of {label(name)} images: {found['point_spread']:.2%} of their width (standard deviation).")
    for sentence in (
        *unrefined_sentences(metrics),
        *correction_sentences(metrics.get("refined", {})),
        *metrics["remarks"],
    ):
        print(sentence)
    run = trainer.run
    pictures = len(list(run.renders.glob("*.png")))
    page = write_results_page(run)
    print(f"Results in {run.path}:")
    if page is not None:
        print(f"  {page.name:<14} numbers, plots and pictures on one page: open it in a browser")
    print(f"  {run.metrics_json.name:<14} the numbers; config.yaml reproduces the run")
    print(f"  {'renders/':<14} {pictures} held-out frames: ground truth | render | error")
    if "refined" in metrics:
        print(f"  {'refined/':<14} the refined cameras, as a COLMAP model of the undistorted images")
    for ply in sorted(run.ply.glob("*.ply")):
        print(f"  ply/{ply.name:<18} opens in third-party splat viewers")
    print(f"A video of it: thermosplat-render {shlex.quote(str(run.path))}")
