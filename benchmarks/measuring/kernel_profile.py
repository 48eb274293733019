"""What a CUDA device does in the steps of a training: which kernels, for how long, and when nothing."""

import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from operator import attrgetter
from typing import Any, NamedTuple

import torch

from measuring.device_time import covered

EXCHANGE = "NCCL"
"""The group of kernels that wait for other devices."""

MARKS = ("ProfilerStep", "nccl:")
"""How the names of ranges begin that torch marks, which are no kernels."""

WARMING = 2
"""Steps under the profiler before those that count: the first replay of a graph that is watched takes longer."""


class Span(NamedTuple):
    """Something that a device did."""

    name: str
    start: float
    """[us]"""
    end: float
    """[us]"""


class KernelTime(NamedTuple):
    """A kernel's part of a step."""

    name: str
    group: str
    ms: float
    calls: float


class Stretch(NamedTuple):
    """Neighbours of one group in a step."""

    start_ms: float
    """From the beginning of the step's first kernel."""
    group: str
    ms: float
    """In which some of them ran."""
    kernels: int
    idle_ms: float
    """Before it, in which nothing ran."""


@dataclass(frozen=True)
class StepProfile:
    """A step of one device, the mean of several."""

    wall_ms: float
    """By the host's clock."""
    busy_ms: float
    """In which some kernel ran, or memory was set or copied."""
    exchange_alone_ms: float
    """In which only kernels ran that wait for other devices."""
    groups: dict[str, float] = field(default_factory=dict)
    """Milliseconds by group. Kernels that run at the same time count each."""
    kernels: list[KernelTime] = field(default_factory=list)
    """The costliest first."""
    order: list[Stretch] = field(default_factory=list)
    """The last step from its beginning to its end; empty where steps differ."""

    @classmethod
    def of(cls, numbers: Mapping[str, Any]) -> "StepProfile":
        """The inverse of ``dataclasses.asdict``, also of what was JSON meanwhile."""
        kernels = [KernelTime(*kernel) for kernel in numbers["kernels"]]
        return cls(**{**numbers, "kernels": kernels, "order": [Stretch(*stretch) for stretch in numbers["order"]]})

    @property
    def idle_ms(self) -> float:
        """In which the device did nothing."""
        return max(self.wall_ms - self.busy_ms, 0.0)


def profiled_step(
    step: Callable[[], object], steps: int, device: torch.device, group_of: Callable[[str], str]
) -> StepProfile:
    """Run steps under torch's profiler, on every rank as many.

    Args:
        step: Launches a step.
        steps: That count.
        device: A CUDA device.
        group_of: The group of a kernel, by its name.
    """
    activities = [torch.profiler.ProfilerActivity.CUDA]
    warm_then_counted = torch.profiler.schedule(wait=0, warmup=1, active=1, repeat=1)
    with torch.profiler.profile(activities=activities, schedule=warm_then_counted) as profile:
        for _ in range(WARMING):
            step()
        torch.cuda.synchronize(device)
        profile.step()
        torch.cuda.synchronize(device)
        started = time.perf_counter()
        for _ in range(steps):
            step()
        torch.cuda.synchronize(device)
        seconds = time.perf_counter() - started
    return summed(spans_of(profile), steps, seconds, group_of)


def spans_of(profile: torch.profiler.profile) -> list[Span]:
    """What the device did in a finished profile of CUDA activities; ranges that programs mark are left out."""
    return [
        Span(event.name, event.time_range.start, event.time_range.end)
        for event in profile.events() or ()
        if event.device_type == torch.autograd.DeviceType.CUDA
        and not getattr(event, "is_user_annotation", False)
        and not event.name.startswith(MARKS)
    ]


def summed(spans: Iterable[Span], steps: int, seconds: float, group_of: Callable[[str], str]) -> StepProfile:
    """What spans say of a step.

    Args:
        spans: Of all steps.
        steps: How many.
        seconds: That they took.
        group_of: The group of a kernel, by its name.
    """
    spans = sorted(spans, key=attrgetter("start"))
    lengths: Counter[str] = Counter()
    calls: Counter[str] = Counter()
    groups: Counter[str] = Counter()
    for span in spans:
        milliseconds = 1e-3 * (span.end - span.start) / steps
        lengths[span.name] += milliseconds
        calls[span.name] += 1
        groups[group_of(span.name)] += milliseconds
    kernels = [KernelTime(name, group_of(name), ms, calls[name] / steps) for name, ms in lengths.most_common()]
    busy = covered((start, end) for _, start, end in spans)
    without = covered((start, end) for name, start, end in spans if group_of(name) != EXCHANGE)
    number, odd = divmod(len(spans), steps)
    alike = number > 0 and odd == 0 and all(count % steps == 0 for count in calls.values())
    return StepProfile(
        wall_ms=1e3 * seconds / steps,
        busy_ms=1e-3 * busy / steps,
        exchange_alone_ms=1e-3 * (busy - without) / steps,
        groups=dict(groups.most_common()),
        kernels=kernels,
        order=_in_order(spans[-number:], group_of) if alike else [],
    )


def _in_order(spans: Sequence[Span], group_of: Callable[[str], str]) -> list[Stretch]:
    """Neighbours of one group, one after the other."""
    found, reached = [], spans[0].start
    for group, members in groupby(spans, key=lambda span: group_of(span.name)):
        members = list(members)
        start, idle = members[0].start, max(members[0].start - reached, 0.0)
        ran = covered((span.start, span.end) for span in members)
        found.append(Stretch(1e-3 * (start - spans[0].start), group, 1e-3 * ran, len(members), 1e-3 * idle))
        reached = max(reached, *(span.end for span in members))
    return found
