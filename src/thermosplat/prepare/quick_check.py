"""The part of a check that training does at its start: what takes an instant, on images that are in memory."""

from collections.abc import Mapping

import numpy as np

from thermosplat.datasets.capture import Capture
from thermosplat.prepare.findings import DRIFT_SHARE, level_drift
from thermosplat.spectra import SpectrumConfig, label

_LEAST_IMAGES = 5


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
        constant = [view.name for view in views if np.ptp(view.image[::4, ::4]) == 0]
        if constant:
            count = f"{len(constant)} of {len(views)} {label(name)} images"
            notes.append(
                f"{count} have one value everywhere (first: {constant[0]}): a closed shutter or a damaged file? "
                "Better remove them."
            )
        images = [view.image[..., 0] for view in views if view.name not in constant]
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
