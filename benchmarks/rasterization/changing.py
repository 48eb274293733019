"""Loops in which no call comes again for long: sizes of images that take turns, and Gaussians that become more."""

import time
from collections.abc import Iterator, Sequence
from typing import Any

import torch

from measuring.timing import summary, wait
from peers.peer import Peer, Tensors
from rasterization.case import inputs_of, passes_of
from scenes.benchmark_scenes import BenchmarkScene

ROUNDS, SIZE_CALLS = 3, 30
"""How often each size of images has its turn, and the calls of a turn."""
GROWTH, GROWTH_CALLS, FIRST_SHARE = 1.05, 100, 0.5
"""As densification of 3DGS-MCMC does: by 5% every 100 steps, here from half of the scene's Gaussians to all."""


def changing_rows(
    scene: BenchmarkScene, case: str, sizes: Sequence[tuple[int, int]], device: torch.device, peers: list[Peer]
) -> Iterator[dict[str, Any]]:
    """Times forward plus backward of both loops, peers in turns, and every call of a turn.

    Args:
        scene: Gaussians and camera.
        case: one of ``peers.CASES``.
        sizes: width and height of the images that take turns [px]. While Gaussians become more, images have the first.
        device: where to render.
        peers: those captured by hand are left out, as they would have to be captured at every change.

    Yields:
        A row for each loop: ``ms_per_call`` by peer, the whole turn by the clock, after the device ends: median, 10th
        and 90th percentile of the turns but the first, which compiles; ``first_ms``: of each turn's first call.
    """
    peers = [peer for peer in peers if case in peer.cases and peer.captured is None]
    of_size = [(size, inputs_of(scene, case, *size, device)) for size in sizes]
    first_size, every = of_size[0]
    grown = [(first_size, _first(every, count)) for count in _counts(len(scene.means))]
    loops = {"sizes take turns": (of_size * ROUNDS, SIZE_CALLS), "Gaussians become more": (grown, GROWTH_CALLS)}
    for loop, (turns, calls) in loops.items():
        whole: dict[str, list[float]] = {peer.name: [] for peer in peers}
        first: dict[str, list[float]] = {peer.name: [] for peer in peers}
        for turn_size, inputs in turns:
            for peer in peers:
                passes = passes_of(peer, case, inputs, turn_size)
                wait(device)
                start_s = time.perf_counter()
                for call in range(calls):
                    passes.forward_backward()
                    if call == 0:
                        wait(device)
                        first[peer.name].append(1e3 * (time.perf_counter() - start_s))
                wait(device)
                whole[peer.name].append(1e3 * (time.perf_counter() - start_s) / calls)
        found = {
            name: {"ms_per_call": summary(times[1:]), "first_ms": summary(first[name][1:])["median_ms"]}
            for name, times in whole.items()
        }
        yield {
            "scene": scene.name,
            "case": case,
            "size": "x".join(map(str, first_size)),
            "loop": loop,
            "changing": found,
        }


def _counts(count: int) -> list[int]:
    """Gaussians of each turn."""
    counts = [int(FIRST_SHARE * count)]
    while counts[-1] < count:
        counts.append(min(int(GROWTH * counts[-1]) + 1, count))
    return counts


def _first(inputs: Tensors, count: int) -> Tensors:
    """Inputs of the first ``count`` Gaussians, as leaves of their own; cameras as they are."""
    return {
        name: tensor.detach()[:count].clone().requires_grad_() if tensor.requires_grad else tensor
        for name, tensor in inputs.items()
    }
