"""Writing a sequence of images as MP4 or as PNGs."""

import importlib.util
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from itertools import chain
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from thermosplat.pictures.image_display import Image8, fitted, write_png
from thermosplat.runs.atomic_writes import write_atomically

VideoFormat = Literal["mp4", "png"]


def write_images(
    images: Iterable[Image8], target: Path, *, format: VideoFormat, fps: int, names: Sequence[str] | None = None
) -> Path:
    """Write images as a video, or as PNGs in a folder.

    MP4 is H.264 by imageio-ffmpeg where that is installed (extra "video"), else OpenCV's MPEG-4, which some browsers do
    not play; where OpenCV has no encoder either, PNGs are written instead.

    Args:
        images: 8-bit RGB images, shape [H, W, 3] each, at least one; consumed once. In a video all are fitted into
            the first one's size.
        target: File or folder without a suffix; ``.mp4`` is appended for a video.
        fps: Images a second of the video, >= 1.
        names: Names of the PNGs without ".png", as many as images. None: numbers.

    Returns:
        The video file, or the folder of PNGs.

    Raises:
        NotWrittenError: Something could not be written; an earlier video is as it was.
    """
    images = iter(images)
    if format == "mp4":
        first = next(images)
        images = chain([first], images)
        try:
            return _write_video(images, target.with_name(f"{target.name}.mp4"), first.shape, fps)
        except NoEncoderError:
            pass  # nothing was consumed
    written = set()
    for index, image in enumerate(images):
        path = target / f"{f'{index:05d}' if names is None else names[index]}.png"
        written.add(path)
        write_png(path, image)
    for earlier in set(target.glob("[0-9]" * 5 + ".png")) - written:
        earlier.unlink()  # of a longer path rendered into this folder before: the sequence would go on with it
    return target


class NoEncoderError(Exception):
    """Neither imageio-ffmpeg nor OpenCV can write a video here."""


def _write_video(images: Iterator[Image8], path: Path, shape: tuple[int, ...], fps: int) -> Path:
    height, width = (size // 2 * 2 for size in shape[:2])  # 4:2:0 chroma needs even sizes: drop a last odd row

    def write(temporary: Path) -> None:
        temporary.touch()  # says why it cannot be written, where the encoders only fail
        with _encoder(temporary, width, height, fps) as append:
            for image in images:
                if image.shape != shape:
                    image = fitted(image, shape[1], shape[0])
                append(np.ascontiguousarray(image[:height, :width]))
        if not _is_complete(temporary):
            raise OSError("the encoder did not complete it, as on a full disk")

    write_atomically(path, write)
    return path


def _is_complete(path: Path) -> bool:
    """Whether the parts of an MP4 fill it and its index is among them: it comes last, and encoders do not say that it
    found no room."""
    size, at, kinds = path.stat().st_size, 0, set()
    with path.open("rb") as file:
        while at < size:
            file.seek(at)
            length, kind = struct.unpack(">I4s", file.read(8).ljust(8, b"\0"))
            if length == 1:  # too long for 32 bits
                length = int.from_bytes(file.read(8), "big")
            kinds.add(kind)
            at += max(length, 8)
    return at == size and b"moov" in kinds


def browsers_play_videos() -> bool:
    """Whether videos are H.264 here, which all browsers play, and not MPEG-4."""
    return importlib.util.find_spec("imageio_ffmpeg") is not None


def _encoder(path: Path, width: int, height: int, fps: int) -> AbstractContextManager[Callable[[Image8], object]]:
    open_encoder = _h264 if browsers_play_videos() else _mpeg4
    return open_encoder(path, width, height, fps)


@contextmanager
def _h264(path: Path, width: int, height: int, fps: int) -> Iterator[Callable[[Image8], object]]:
    import imageio_ffmpeg

    writer = imageio_ffmpeg.write_frames(
        str(path), (width, height), fps=fps, codec="libx264", quality=8, macro_block_size=2, ffmpeg_log_level="error"
    )
    writer.send(None)

    def append(image: Image8) -> None:
        try:
            writer.send(image)
        except OSError as error:  # its message is the whole command; ffmpeg itself has said more on stderr
            raise OSError("ffmpeg ended early") from error

    try:
        yield append
    finally:
        writer.close()


@contextmanager
def _mpeg4(path: Path, width: int, height: int, fps: int) -> Iterator[Callable[[Image8], object]]:
    try:
        str(path).encode()
    except UnicodeEncodeError as error:  # OpenCV would crash
        raise NoEncoderError from error
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, (width, height))
    if not writer.isOpened():
        raise NoEncoderError
    try:
        yield lambda image: writer.write(image[..., ::-1])
    finally:
        writer.release()
