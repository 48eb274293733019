"""The part of a check that training does at its start: what takes an instant, on images in memory, or some others.

What would train without a word and come out wrong is told here: poses of other images, spectra that do not lie on each
other, images that are there twice, temperatures in another unit.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.capture import Capture, Frame, View
from thermosplat.datasets.random_points import STARTING_RANDOM
from thermosplat.prepare.checking.findings import DRIFT_SHARE, Finding, level_drift
from thermosplat.prepare.checking.plausible_temperatures import temperature_notes
from thermosplat.prepare.checking.pose_accuracy import LONG_SIDE, MOST_REFINED, pose_accuracy
from thermosplat.prepare.checking.posed_photographs import exposure_drift, pose_notes, unseen_share
from thermosplat.prepare.checking.repeated_images import repeated_notes, shows_something
from thermosplat.prepare.checking.spectra_together import together_notes
from thermosplat.spectra import SpectrumConfig, label

_LEAST_IMAGES = 5
_READ_FROM_DISK = 16
"""Images that are looked at where they stay on the disk."""
_MOST_UNSEEN = 0.5
"""Share of the sparse points that may lie in no image. Open choice: good captures have none to 0.02."""
_EXPOSURE = 0.17
"""Standard deviation of the photographs' brightness, as a share, that is told. Open choice: photographs with automatic
exposure have up to 0.12."""


def quick_findings(
    capture: Capture, spectra: Mapping[str, SpectrumConfig], refined: Collection[str] = ()
) -> list[Finding]:
    """What is probably wrong, and a sensor that drifts without the training allowing for it."""
    drifts = (Finding("warning", note) for note in drift_notes(capture, spectra))
    return [*wrong_findings(capture, spectra, refined), *drifts]


def wrong_findings(
    capture: Capture, spectra: Mapping[str, SpectrumConfig], refined: Collection[str] = ()
) -> list[Finding]:
    """A sentence on each thing that is probably wrong with a capture that can be read, and settings that help."""
    frames = sorted((*capture.train, *capture.test), key=lambda frame: frame.name)
    if capture.on_disk is not None:
        frames = [_in_memory(frame) for frame in frames[:: -(-len(frames) // _READ_FROM_DISK)]]
    notes: list[str] = []
    helped: list[Finding] = []
    points = capture.points[:0] if any(STARTING_RANDOM in note for note in capture.notes) else capture.points
    lead = next((name for name, scale in capture.scales.items() if scale.kind == "photograph"), None)
    if lead is not None and len(points):
        views = [view for view in _views(frames, lead) if shows_something(view)]
        notes += pose_notes(views, points, capture.point_colors)
        if views and not notes and (unseen := unseen_share(views, points)) > _MOST_UNSEEN:
            notes.append(
                f"{unseen:.0%} of the sparse points lie in no photograph: are points and poses of one capture? Make "
                "both anew (colmap mapper, thermosplat-prepare sfm)."
            )
        if not notes and spectra[lead].exposure == "fixed":
            drift = exposure_drift(views, points, capture.point_colors)
            if drift > _EXPOSURE:
                sentence = (
                    f"The exposure of {label(lead)} images varies by {drift:.0%} (standard deviation of what they show "
                    f"of the same points): --{lead}.exposure affine learns it."
                )
                helped.append(Finding("warning", sentence, {"spectra": {lead: {"exposure": "affine"}}}))
    if lead is not None and not notes and "poses" not in refined:
        helped += _inexact_poses(lead, _views(frames, lead))
    posed = bool(len(points)) and not notes
    held_out = {frame.name for frame in capture.test}
    train, test = ([frame for frame in frames if (frame.name in held_out) is held] for held in (False, True))
    for name, scale in capture.scales.items():
        if not scale.is_taken:
            continue
        notes += repeated_notes(name, _views(train, name), _views(test, name))
        notes += temperature_notes(name, _sampled(_views(frames, name)), scale)
        if lead is not None and name != lead:
            both = [(frame.views[lead], frame.views[name]) for frame in frames if {lead, name} <= set(frame.views)]
            pairs = [pair for pair in both if all(map(shows_something, pair))]
            notes += together_notes(name, pairs, points, posed=posed)
    return [*(Finding("warning", note) for note in notes), *helped]


def _inexact_poses(name: str, views: Sequence[View]) -> list[Finding]:
    """A sentence (none or one) on poses that another look at the photographs contradicts."""
    accuracy = pose_accuracy([view for view in views if shows_something(view)])
    if accuracy is None or not accuracy.inexact:
        return []
    lies = (
        f"what two images share lies {accuracy.stated:.1f} px from where their poses say (median, of images "
        f"{LONG_SIDE} px wide), and {accuracy.fitted:.1f} px with poses that fit"
    )
    if accuracy.stated > MOST_REFINED:
        remedy = "Find them anew: colmap automatic_reconstructor, or thermosplat-prepare sfm."
        return [Finding("warning", f"Poses of {label(name)} images are wrong: {lies}. {remedy}")]
    sentence = f"Poses of {label(name)} images are inexact: {lies}: --refine poses corrects them."
    return [Finding("warning", sentence, {"refine": ["poses"]})]


def _in_memory(frame: Frame) -> Frame:
    """The frame with the pixels that stay on the disk, which are looked at more than once."""

    def read(view: View) -> View:
        pixels = view.pixels()
        return replace(view, image=pixels.image, values=pixels.values, mask=pixels.mask, stored=None)

    return Frame(frame.name, {name: read(view) for name, view in frame.views.items()})


def _views(frames: Sequence[Frame], spectrum: str) -> list[View]:
    return [frame.views[spectrum] for frame in frames if spectrum in frame.views]


def drift_notes(capture: Capture, spectra: Mapping[str, SpectrumConfig]) -> list[str]:
    """Notes on sensors that drift without the training allowing for it."""
    notes = []
    for name, scale in capture.scales.items():
        if scale.kind != "scalar":
            continue
        views = [frame.views[name] for frame in (*capture.train, *capture.test) if name in frame.views]
        images = [image for view in _sampled(views) if np.ptp((image := _looked_at(view))[::4, ::4]) > 0]
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
