"""What a user should be told once about a capture that loads nevertheless."""

from collections.abc import Sequence

from thermosplat.datasets.capture import Frame
from thermosplat.datasets.frame_files import FrameFiles


def pairing_notes(frames: Sequence[Frame]) -> list[str]:
    """Say how many frames lack a partner, where some have one."""
    notes = []
    if any(frame.rgb is not None for frame in frames) and any(frame.thermal is not None for frame in frames):
        for lacking, present in (("thermal", "RGB"), ("RGB", "thermal")):
            lone = [frame for frame in frames if (frame.thermal if lacking == "thermal" else frame.rgb) is None]
            if lone:
                total = sum((frame.rgb if present == "RGB" else frame.thermal) is not None for frame in frames)
                notes.append(
                    f"{len(lone)} of {total} {present} images have no {lacking} partner (first: {lone[0].name}); "
                    f"they are trained as {present} alone. Pairs are matched by file stem."
                )
    return notes


def distortion_notes(frames: Sequence[FrameFiles]) -> list[str]:
    """Say (once) that images were undistorted, and of which cameras."""
    models = {
        shot.lens.model
        for frame in frames
        for shot in (frame.rgb, frame.thermal)
        if shot is not None and shot.lens.distorted
    }
    if not models:
        return []
    return [f"Images of {' and '.join(sorted(models))} cameras were undistorted to pinhole images in memory."]
