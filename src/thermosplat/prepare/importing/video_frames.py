"""Frames of videos, by OpenCV."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.errors import UserError

VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm"})
_USUAL_RATE = 30.0
"""Frames per second of a video that does not say."""


def describe_video(path: Path) -> tuple[int, float, int, int]:
    """Number of frames, frames per second, width and height [px] of a video.

    Raises:
        UserError: OpenCV cannot read it, or its name.
    """
    video = _opened(path)
    try:
        count, rate = int(video.get(cv2.CAP_PROP_FRAME_COUNT)), float(video.get(cv2.CAP_PROP_FPS))
        done, image = video.read()
    finally:
        video.release()
    if not done or count < 1:
        raise UserError(f"OpenCV cannot read the video {path}.", "Export its frames as images.")
    return count, rate if rate > 0 else _USUAL_RATE, image.shape[1], image.shape[0]


def read_video_frame(path: Path, number: int) -> NDArray[np.uint8]:
    """A frame of a video, counted from 0.

    Returns:
        uint8 [H, W, 3] RGB.

    Raises:
        UserError: It cannot be decoded.
    """
    video = _opened(path)
    try:
        video.set(cv2.CAP_PROP_POS_FRAMES, number)
        done, image = video.read()
    finally:
        video.release()
    if not done:
        raise UserError(f"Frame {number} of {path} cannot be decoded.", "Export the frames as images.")
    colors: Any = image[..., ::-1]
    return np.ascontiguousarray(colors)


def _opened(path: Path) -> cv2.VideoCapture:
    try:
        str(path).encode()
    except UnicodeEncodeError as error:  # OpenCV would crash
        raise UserError(f"The name of the video {path} is not UTF-8.", "Rename it.") from error
    return cv2.VideoCapture(str(path))


def moment(seconds: float) -> str:
    """Time since a video's beginning in the form of a date, on a day that nobody takes for the day of the video."""
    minutes, second = divmod(round(seconds, 3), 60)
    hours, minute = divmod(int(minutes), 60)
    return f"1970-01-{1 + hours // 24:02d}T{hours % 24:02d}:{minute:02d}:{second:06.3f}"
