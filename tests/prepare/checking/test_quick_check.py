"""What training says at its start."""

from dataclasses import replace

import numpy as np

from thermosplat.datasets import load_capture
from thermosplat.datasets.capture import Capture, Frame, View
from thermosplat.prepare.checking.quick_check import drift_notes
from thermosplat.spectra import DEFAULT_SPECTRA
from thermosplat.thermal.radiometry import PixelScale


def scalar(capture: Capture, change: float) -> Capture:
    """The sample with one value per thermal pixel, and a level that moves by ``change`` from frame to frame."""

    def changed(place: int, frame: Frame) -> Frame:
        view: View = frame.views["thermal"]
        image = view.image[..., 1:2] / np.float32(510) + np.float32(change * place)
        return replace(frame, views={**frame.views, "thermal": replace(view, image=image)})

    train = tuple(changed(place, frame) for place, frame in enumerate(capture.train))
    return replace(capture, train=train, test=(), scales={**capture.scales, "thermal": PixelScale("scalar")})


def test_steady_and_drifting_sensors() -> None:
    """A steady sensor says nothing; one that drifts names the flag, unless that is set."""
    sample = load_capture("sample")
    assert drift_notes(sample, DEFAULT_SPECTRA) == []
    assert drift_notes(scalar(sample, 0.0), DEFAULT_SPECTRA) == []
    drifting = scalar(sample, 0.02)
    (note,) = drift_notes(drifting, DEFAULT_SPECTRA)
    assert "--thermal.exposure level" in note
    allowed = {**DEFAULT_SPECTRA, "thermal": replace(DEFAULT_SPECTRA["thermal"], exposure="level")}
    assert drift_notes(drifting, allowed) == []
