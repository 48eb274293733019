"""Frames one after the other with their pixels in memory, though these stay on the disk."""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

from thermosplat.datasets.capture import Frame


def read_ahead(frames: Sequence[Frame]) -> Iterator[Frame]:
    """Frames in their order; the next one is read by another thread meanwhile, and two are in memory at a time.

    Args:
        frames: The frames; those in memory come as they are.

    Raises:
        ImageLostError: An image cannot be read.
    """
    unread = [view.stored for frame in frames for view in frame.views.values() if view.stored is not None]
    if not unread:
        yield from frames
        return
    with ThreadPoolExecutor(max_workers=1) as thread:
        upcoming = thread.submit(in_memory, frames[0])
        for place in range(len(frames)):
            frame = upcoming.result()
            if place + 1 < len(frames):
                upcoming = thread.submit(in_memory, frames[place + 1])
            yield frame


def in_memory(frame: Frame) -> Frame:
    """The frame with the pixels of its views in memory.

    Raises:
        ImageLostError: An image cannot be read.
    """
    views = {}
    for name, view in frame.views.items():
        if view.stored is not None:
            view.stored.check()
            pixels = view.stored.read()
            view = replace(view, image=pixels.image, values=pixels.values, mask=pixels.mask, stored=None)
        views[name] = view
    return replace(frame, views=views)
