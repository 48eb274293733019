"""How close a model comes to images that it was trained on: what its held-out views are to be judged beside.

A scene that is little better than one colour was not learnt. One that fits its training views far better than others
has learnt what only those show: wrong depths, noise, or poses that do not fit together.
"""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from thermosplat.datasets.capture import Capture
from thermosplat.evaluation.held_out import rendered_views
from thermosplat.scene.model import SceneModel
from thermosplat.spectra import label

LOOKED_AT = 12
"""Training frames, spread over all, that are rendered. Open choice."""
LEARNT = 3.0
"""Decibels above the best single colour from which on a spectrum counts as learnt: half of what its images vary by is
explained. Open choice; images of 30 electrons have 6 and more (benchmarks/records/real-captures.md)."""
FALLEN = 8.0
"""Decibels that held-out views may lie below training views before a run speaks of it. Open choice: captures that are
good otherwise have 1 to 6 (benchmarks/records/real-captures.md)."""


def one_color_error(targets: list[Tensor]) -> float:
    """Mean squared error of the single colour that is nearest to images [H, W, C]."""
    count = sum(target[..., 0].numel() for target in targets)
    mean = torch.stack([target.double().sum(dim=(0, 1)) for target in targets]).sum(0) / count
    squares = torch.stack([(target.double() - mean).square().mean(-1).sum() for target in targets])
    return (squares.sum() / count).item()


@torch.no_grad()
def training_views(model: SceneModel, capture: Capture, *, sh_degree: int) -> dict[str, dict[str, float]]:
    """PSNR of some training views [dB], and what the best single colour has, by spectrum.

    Args:
        capture: Its capture, of which some of ``capture.train`` are rendered.
    """
    errors: dict[str, list[float]] = {}
    targets: dict[str, list[Tensor]] = {}
    for frame in capture.train[:: -(-len(capture.train) // LOOKED_AT)]:
        for view in rendered_views(model, frame, capture.scales, sh_degree):
            graded = model.formations[view.spectrum].graded_truth
            target = graded(view.target)
            errors.setdefault(view.spectrum, []).append((graded(view.counted) - target).square().mean().item())
            targets.setdefault(view.spectrum, []).append(target)
    return {
        name: {
            "psnr": _decibels(sum(found) / len(found)),
            "one_color_psnr": _decibels(one_color_error(targets[name])),
        }
        for name, found in errors.items()
    }


def remarks(metrics: Mapping[str, Any], fixed_budget: bool) -> list[str]:
    """What to tell the user of spectra that were not learnt, or that training views alone show well.

    Args:
        metrics: Of the run, with "training_views".
        fixed_budget: Whether ``--budget auto`` was not asked for.
    """
    lines = []
    for name, trained in metrics["training_views"].items():
        held_out = metrics.get(name)
        if trained["psnr"] < trained["one_color_psnr"] + LEARNT:
            lines.append(
                f"The scene did not learn its {label(name)} images: training views have {trained['psnr']:.1f} dB, one "
                f"colour alone {trained['one_color_psnr']:.1f}. Are the poses right (thermosplat-prepare check)?"
            )
        elif held_out is not None and trained["psnr"] > held_out["psnr"] + FALLEN:
            remedy = "--budget auto leaves out what other views do not confirm" if fixed_budget else "more images help"
            lines.append(
                f"Held-out {label(name)} views are {trained['psnr'] - held_out['psnr']:.1f} dB below training views "
                f"({held_out['psnr']:.1f}, {trained['psnr']:.1f}): the scene fits what only those show; {remedy}."
            )
    return lines


def _decibels(squared_error: float) -> float:
    return -10.0 * torch.log10(torch.tensor(max(squared_error, 1e-12), dtype=torch.float64)).item()
