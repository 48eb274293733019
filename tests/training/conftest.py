"""Fixtures of the training tests."""

from collections.abc import Iterator

import pytest
import torch

from thermosplat.training.budget import image_change
from toy_run import toy_sizes


@pytest.fixture(autouse=True, scope="module")
def _one_torch_thread() -> Iterator[None]:
    """Images of a few hundred pixels gain nothing from more threads, and lose much where cores are shared."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(autouse=True, scope="module")
def _toy_sizes() -> Iterator[None]:
    """Of the Gaussians of toy captures, also in runs that a module shares."""
    with toy_sizes():
        yield


@pytest.fixture(autouse=True)
def _toy_scenes_are_learnt() -> Iterator[None]:
    """Toy images are noise, which no scene learns: a budget removes what it would remove of one that is learnt."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(image_change, "LEARNT", -300.0)
        yield
