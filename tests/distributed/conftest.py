"""Ranks that the tests of this room share: starting a process takes longer than what it is asked for."""

from collections.abc import Iterator

import pytest
import torch

from ranks import Ranks
from toy_run import toy_sizes


@pytest.fixture(autouse=True, scope="module")
def _one_torch_thread() -> Iterator[None]:
    """Each rank has one thread; the process that it is compared with, too."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def ranks() -> Iterator[Ranks]:
    """Three processes."""
    started = Ranks(3)
    yield started
    started.close()


@pytest.fixture(autouse=True)
def _toy_sizes() -> Iterator[None]:
    """Of the Gaussians of toy captures."""
    with toy_sizes():
        yield
