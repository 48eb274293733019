"""Which spectra one camera shows, so that one traversal renders them together."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from thermosplat.datasets.frame_tensors import ViewTensors


def views_by_camera(views: Mapping[str, "ViewTensors"]) -> list[list[str]]:
    """Spectra in groups whose views have one camera, pose and size.

    Reads values back from the device; ``Frame.shared_cameras`` says the same of a capture's frame beforehand.
    """
    groups: list[list[str]] = []
    for name, view in views.items():
        for group in groups:
            if _same_camera(views[group[0]], view):
                group.append(name)
                break
        else:
            groups.append([name])
    return groups


def _same_camera(one: "ViewTensors", other: "ViewTensors") -> bool:
    return (
        (one.width, one.height, one.orthographic, one.lens_model, one.line_order)
        == (other.width, other.height, other.orthographic, other.lens_model, other.line_order)
        and torch.equal(one.K, other.K)
        and torch.equal(one.viewmat, other.viewmat)
        and _equal(one.distortion, other.distortion)
        and _equal(one.lens, other.lens)
        and _equal(one.readout, other.readout)
    )


def _equal(one: Tensor | None, other: Tensor | None) -> bool:
    return one is other or (one is not None and other is not None and torch.equal(one, other))
