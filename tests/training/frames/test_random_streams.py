"""Randomness is a function of seed, purpose and index."""

import torch

from thermosplat.training.frames.random_streams import random_stream
from thermosplat.training.frames.spectrum_schedule import FrameOrder


def test_streams_are_named() -> None:
    """The same name draws the same; another seed, purpose or index draws something else."""

    def draw(*name: object) -> list[float]:
        return torch.randn(4, generator=random_stream(*name)).tolist()  # type: ignore[arg-type]

    names = [(1, "split", 600), (2, "split", 600), (1, "frame order", 600), (1, "split", 700)]
    draws = [draw(*name) for name in names]
    assert [draw(*name) for name in names] == draws
    assert len({tuple(values) for values in draws}) == len(names)


def test_every_frame_once_an_epoch() -> None:
    """Each run through the frames takes all of them, in an order of its own."""
    order = FrameOrder(9, seed=42)
    epochs = [[order[step] for step in range(9 * epoch, 9 * epoch + 9)] for epoch in range(4)]
    assert all(sorted(epoch) == list(range(9)) for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) == 4


def test_order_does_not_depend_on_where_one_starts() -> None:
    """A resumed run, starting in the middle of an epoch, takes the frames the first run would have taken."""
    whole = FrameOrder(7, seed=3)
    steps = [whole[step] for step in range(30)]
    resumed = FrameOrder(7, seed=3)
    assert [resumed[step] for step in range(17, 30)] == steps[17:]
    assert [resumed[step] for step in reversed(range(30))] == steps[::-1]


def test_order_depends_on_the_seed() -> None:
    """Two seeds see the frames in different orders."""
    assert [FrameOrder(50, 1)[step] for step in range(50)] != [FrameOrder(50, 2)[step] for step in range(50)]
