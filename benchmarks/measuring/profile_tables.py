"""Profiles of a step on one device and on several, side by side as Markdown."""

from collections.abc import Iterator, Sequence

from measuring.kernel_profile import StepProfile

KERNELS = 40
"""How many kernels are listed, the costliest first."""

LONGEST_NAME = 100
"""Letters of a kernel's name that are shown."""

NOTHING = "The profiler saw no kernel of this device: another program may be profiling it."


def profile_tables(title: str, profiles: Sequence[StepProfile], alone: StepProfile | None = None) -> str:
    """Tables of a step: groups, kernels, and the step from its beginning to its end.

    Args:
        title: What the steps are of.
        profiles: Of each rank.
        alone: Of one device that does the same frames and has all Gaussians; None: was not measured. Beside it stands
            the rank's time minus that device's time by the number of ranks.
    """
    lines = ["", f"**{title}**", ""]
    if all(not profile.kernels for profile in profiles):
        return "\n".join([*lines, NOTHING, ""])
    lines += [*_groups(profiles, alone), ""]
    for rank, profile in enumerate(profiles):
        of_rank = f"Rank {rank}: " if len(profiles) > 1 else ""
        if not profile.kernels:
            lines += [f"{of_rank}{NOTHING}", ""]
            continue
        lines += [f"{of_rank}kernels of a step", "", *_kernels(profile, len(profiles), alone), ""]
        if profile.order:
            lines += [f"{of_rank}the last step, in order", "", *_order(profile), ""]
    return "\n".join(lines)


def _groups(profiles: Sequence[StepProfile], alone: StepProfile | None) -> Iterator[str]:
    ranks = len(profiles)
    head = ["ms per step", *(f"rank {rank}" for rank in range(ranks))]
    if alone is not None:
        head += [f"one device / {ranks}", "most of a rank - that"]
    yield from _head(head)
    every = [*profiles] if alone is None else [*profiles, alone]
    names = dict.fromkeys(name for profile in every for name in profile.groups)
    rows = {name: [profile.groups.get(name, 0.0) for profile in profiles] for name in names}
    of_one = {} if alone is None else {name: alone.groups.get(name, 0.0) for name in names}
    for name in ("wall_ms", "busy_ms", "idle_ms", "exchange_alone_ms"):
        shown = {"wall_ms": "step", "busy_ms": "busy", "idle_ms": "idle", "exchange_alone_ms": "NCCL alone"}[name]
        rows[f"*{shown}*"] = [getattr(profile, name) for profile in profiles]
        of_one[f"*{shown}*"] = getattr(alone, name) if alone is not None else 0.0
    for name, values in rows.items():
        cells = [name, *(f"{value:.3f}" for value in values)]
        if alone is not None:
            share = of_one[name] / ranks
            cells += [f"{share:.3f}", f"{max(values) - share:+.3f}"]
        yield f"| {' | '.join(cells)} |"


def _kernels(profile: StepProfile, ranks: int, alone: StepProfile | None) -> Iterator[str]:
    of_one = {} if alone is None else {kernel.name: kernel for kernel in alone.kernels}
    head = ["kernel", "group", "calls", "ms"]
    yield from _head(head if alone is None else [*head, f"one device: calls, ms / {ranks}"])
    for kernel in profile.kernels[:KERNELS]:
        name = kernel.name.replace("|", "\\|")[:LONGEST_NAME]
        cells = [f"`{name}`", kernel.group, f"{kernel.calls:g}", f"{kernel.ms:.3f}"]
        if alone is not None:
            found = of_one.get(kernel.name)
            cells.append("-" if found is None else f"{found.calls:g}, {found.ms / ranks:.3f}")
        yield f"| {' | '.join(cells)} |"


def _order(profile: StepProfile) -> Iterator[str]:
    yield from _head(["from [ms]", "group", "kernels", "ms", "idle before [ms]"])
    for start, group, milliseconds, kernels, idle in profile.order:
        yield f"| {start:.3f} | {group} | {kernels} | {milliseconds:.3f} | {idle:.3f} |"


def _head(names: Sequence[str]) -> Iterator[str]:
    yield f"| {' | '.join(names)} |"
    yield "|" + "---|" * len(names)
