"""What a user should be told once about a capture that loads nevertheless."""

from collections.abc import Mapping, Sequence

from thermosplat.config import LensUse
from thermosplat.datasets.capture import Frame
from thermosplat.datasets.frame_files import FrameFiles
from thermosplat.spectra import SpectrumConfig, label, listed


def pairing_notes(frames: Sequence[Frame], spectra: Mapping[str, SpectrumConfig]) -> list[str]:
    """Say how many frames lack an image of a spectrum that others have.

    Args:
        frames: All frames.
        spectra: The spectra that were looked for.
    """
    notes = []
    for name in spectra:
        lone = [frame for frame in frames if name not in frame.views]
        if lone and len(lone) < len(frames):
            there = dict.fromkeys(other for frame in lone for other in frame.views)
            notes.append(
                f"{len(lone)} of {len(frames)} frames have no {label(name)} image (first: {lone[0].name}); they are "
                f"trained on {listed(list(there))} alone. Images are matched by file stem."
            )
    return notes


def distortion_notes(frames: Sequence[FrameFiles], lens: LensUse) -> list[str]:
    """Say (once) what was done about distorted lenses, and of which cameras."""
    models = {shot.lens.model for frame in frames for shot in frame.shots.values() if shot.lens.distorted}
    if not models:
        return []
    cameras = f"Images of {' and '.join(sorted(models))} cameras"
    if lens == "direct":
        return [f"{cameras} stay as they were taken: they are rendered through the lens."]
    return [f"{cameras} were undistorted to pinhole images in memory."]
