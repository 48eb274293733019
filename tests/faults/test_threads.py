"""Threads that use kernels which are not loaded yet: servers, viewers and data loaders do that."""

from pathlib import Path

import pytest
import torch

from forked_processes import run_python

FIRST_RENDERS = """
import faulthandler, sys, threading
import torch
faulthandler.enable()
from thermosplat.rasterizer import rasterization, rasterization_rgbt

def scene():
    generator = torch.Generator().manual_seed(0)
    N = 60
    values = {
        "means": torch.randn(N, 3, generator=generator), "quats": torch.randn(N, 4, generator=generator),
        "scales": 0.1 + torch.rand(N, 3, generator=generator), "opacities": torch.rand(N, generator=generator),
        "thermal_opacities": torch.rand(N, generator=generator),
        "colors": torch.randn(N, 16, 3, generator=generator), "features": torch.randn(N, 4, generator=generator),
    }
    return {name: value.requires_grad_() for name, value in values.items()}

def first_render():
    values = scene()
    viewmat, K = torch.eye(4), torch.tensor([[30.0, 0, 16], [0, 30.0, 12], [0, 0, 1]])
    viewmat[2, 3] = 5.0
    out = rasterization_rgbt(*values.values(), viewmat[None], K[None], 32, 24, sh_degree=3)
    images = [out.render_colors, out.render_features, out.render_thermal_features]
    names = ("means", "quats", "scales", "opacities", "colors")
    single, _, _ = rasterization(*[values[name] for name in names], viewmat[None], K[None], 32, 24, sh_degree=3)
    sum(image.square().sum() for image in (*images, single)).backward()
    return [image.detach() for image in (*images, single)] + [value.grad for value in values.values()]

def run(place):
    together.wait()
    found[place] = first_render()

count = int(sys.argv[1])
torch.set_num_threads(1)
found, together = [None] * count, threading.Barrier(count)
threads = [threading.Thread(target=run, args=(place,)) for place in range(count)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
torch.save(found, sys.argv[2])
"""


def first_renders(threads: int, path: Path) -> list[list[torch.Tensor]]:
    """Images and gradients that each thread of a new process found, all threads having begun at the same moment."""
    done = run_python("-c", FIRST_RENDERS, str(threads), path, seconds=300)
    assert done.returncode == 0, done.stderr[-4000:]
    return torch.load(path)


@pytest.fixture(scope="module")
def of_one_thread(tmp_path_factory: pytest.TempPathFactory) -> list[torch.Tensor]:
    """What one thread finds; afterwards the kernels are compiled."""
    return first_renders(1, tmp_path_factory.mktemp("one") / "found.pt")[0]


def check(threads: int, path: Path, expected: list[torch.Tensor]) -> None:
    """No thread crashes, and each finds what one finds alone, to the last bit."""
    found = first_renders(threads, path)
    assert len(found) == threads
    assert all(len(of_thread) == len(expected) for of_thread in found)
    different = [
        (place, number)
        for place, of_thread in enumerate(found)
        for number, (one, other) in enumerate(zip(of_thread, expected, strict=True))
        if not torch.equal(one, other)
    ]
    assert not different


@pytest.mark.rotating
@pytest.mark.parametrize("threads", [2, 4, 20])
def test_first_renders_come_from_several_threads(
    threads: int, tmp_path: Path, of_one_thread: list[torch.Tensor]
) -> None:
    """The kernels are compiled, and loaded by whoever comes first."""
    check(threads, tmp_path / "found.pt", of_one_thread)


@pytest.mark.slow
@pytest.mark.parametrize("threads", [2, 4, 20])
def test_first_renders_of_many_processes(threads: int, tmp_path: Path, of_one_thread: list[torch.Tensor]) -> None:
    """Ten processes each: what goes wrong between threads goes wrong now and then."""
    for _ in range(10):
        check(threads, tmp_path / "found.pt", of_one_thread)
