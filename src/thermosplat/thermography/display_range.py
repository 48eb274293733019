"""Between which values pictures are coloured, so that one cold corner does not make all the rest one colour."""

import numpy as np

from thermosplat.datasets.capture import Capture

_PERCENTILES = (0.5, 99.5)
"""Of the training images' values."""
_MARGIN = 0.05
"""Of their span, on each side."""
_WIDER = 2.0
"""How many times as wide the whole range must be for the percentiles to take its place."""
_VIEWS, _PIXELS = 24, 10_000
"""That are looked at: views, evenly chosen, and pixels of each."""


def display_range(capture: Capture, spectrum: str) -> tuple[float, float] | None:
    """Values at the ends of the palette in pictures of a spectrum.

    Returns:
        The whole range that intensities stand for, or where a few values alone make it wide, that of the others; None
        where nothing is measured. Pseudo-colours keep theirs: they are colours already.
    """
    scale = capture.scales.get(spectrum)
    if scale is None or scale.range is None or scale.measured_unit is None:
        return None
    low, high = scale.range
    views = [frame.views[spectrum] for frame in capture.train if spectrum in frame.views]
    if scale.kind != "scalar" or not views:
        return low, high
    parts = []
    for view in views[:: max(1, len(views) // _VIEWS)]:
        pixels = view.pixels()
        values = pixels.values if pixels.values is not None else low + pixels.image[..., 0] * (high - low)
        parts.append(values.ravel()[:: max(1, values.size // _PIXELS)])
    found = np.concatenate(parts)
    found = found[np.isfinite(found)]
    if not len(found):
        return low, high
    first, last = (float(end) for end in np.percentile(found, _PERCENTILES))
    margin = _MARGIN * (last - first)
    if last <= first or high - low < _WIDER * (last - first):
        return low, high
    return max(low, first - margin), min(high, last + margin)


def times_as_wide(capture: Capture, spectrum: str) -> float:
    """How many times as wide as what pictures show the range of a spectrum's values is, at least 1."""
    shown, scale = display_range(capture, spectrum), capture.scales.get(spectrum)
    if shown is None or scale is None or scale.range is None or shown[1] <= shown[0]:
        return 1.0
    return max(1.0, (scale.range[1] - scale.range[0]) / (shown[1] - shown[0]))
