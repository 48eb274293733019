"""The part of a check that training does at its start: what takes an instant, on images in memory, or some others."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.capture import Capture, View
from thermosplat.prepare.checking.findings import DRIFT_SHARE, level_drift
from thermosplat.prepare.counted import agreeing, counted
from thermosplat.spectra import SpectrumConfig, label

_LEAST_IMAGES = 5
_READ_FROM_DISK = 16
"""Images that are looked at where they stay on the disk."""


def quick_notes(capture: Capture, spectra: Mapping[str, SpectrumConfig]) -> list[str]:
    """Notes on images of one value everywhere, and on a sensor that drifts without the training allowing for it.

    Args:
        capture: The capture, read.
        spectra: The settings that it will be trained with.
    """
    notes = []
    for name, scale in capture.scales.items():
        if scale.kind != "scalar":
            continue
        views = [frame.views[name] for frame in (*capture.train, *capture.test) if name in frame.views]
        seen = [(view.name, _looked_at(view)) for view in _sampled(views)]
        constant = [view for view, image in seen if np.ptp(image[::4, ::4]) == 0]
        if constant:
            count = f"{len(constant)} of {counted(len(seen), f'{label(name)} image')}"
            notes.append(
                f"{count} {agreeing(len(constant), 'has', 'have')} one value everywhere (first: {constant[0]}): "
                "a closed shutter or a damaged file? "
                f"Better remove {agreeing(len(constant), 'it', 'them')}."
            )
        images = [image for view, image in seen if view not in constant]
        if spectra[name].exposure != "fixed" or len(images) < _LEAST_IMAGES:
            continue
        drift, spread = level_drift(images)
        if drift > DRIFT_SHARE * spread:
            share = f"{drift / max(spread, 1e-9):.0%}"
            notes.append(
                f"The level of {label(name)} images varies by {share} of the scene's own spread. "
                f"If the sensor drifts, --{name}.exposure level learns that."
            )
    return notes


def _sampled(views: Sequence[View]) -> Sequence[View]:
    """Views in memory all, of those on the disk some that are spread over all."""
    on_disk = any(view.image is None for view in views)
    return views[:: -(-len(views) // _READ_FROM_DISK)] if on_disk else views


def _looked_at(view: View) -> NDArray[Any]:
    """The image, [H, W]; of one that is read for this alone every fourth pixel."""
    image = view.pixels().image[..., 0]
    return image if view.stored is None else image[::4, ::4].copy()
