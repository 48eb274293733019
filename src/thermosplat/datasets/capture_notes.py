"""What a user should be told once about a capture that loads nevertheless."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from thermosplat.config import LensUse
from thermosplat.datasets.capture import Frame
from thermosplat.datasets.frame_files import FrameFiles
from thermosplat.datasets.images.masks import mask_files
from thermosplat.errors import UserError
from thermosplat.spectra import SpectrumConfig, label, listed


def pairing_notes(frames: Sequence[Frame], spectra: Mapping[str, SpectrumConfig]) -> list[str]:
    """Say how many frames lack an image of a spectrum that others have."""
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


def mask_notes(frames: Sequence[Frame], files: Sequence[FrameFiles], root: Path) -> list[str]:
    """Say of which images some pixels do not count, and which masks are of no image.

    Raises:
        UserError: No pixel of a spectrum counts.
    """
    notes = []
    for name in dict.fromkeys(name for frame in frames for name in frame.views):
        views = [frame.views[name] for frame in frames if name in frame.views]
        on_disk = sum(view.stored is not None and view.stored.may_be_masked for view in views)
        counting = [float(view.mask.mean()) for view in views if view.mask is not None]
        if on_disk:
            notes.append(f"{on_disk} of {len(views)} {label(name)} images may have pixels that do not count (masks).")
        if not counting:
            continue
        if len(counting) == len(views) and not any(counting):
            raise UserError(
                f"No pixel of the {label(name)} images counts: their masks are black everywhere.",
                "What is to be trained on must not be black in a mask, nor transparent in an image.",
            )
        black = counting.count(0.0)
        share = sum(1 - one for one in counting) / len(views)
        notes.append(
            f"{len(counting)} of {len(views)} {label(name)} images have pixels that do not count (masks, "
            f"transparency), {share:.1%} of all" + (f"; of {black} images none counts." if black else ".")
        )
    used = {shot.mask.resolve() for frame in files for shot in frame.shots.values() if shot.mask is not None}
    unused = [path for path in mask_files(root) if path.resolve() not in used]
    if unused:
        notes.append(f"{len(unused)} masks are of no image (first: {unused[0].relative_to(root)}).")
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
