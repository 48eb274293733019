"""What the rows of bench_rasterization.py amount to: ratios to gsplat over scenes and sizes, beside the targets."""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

from peers.renderers import ALL_OURS, OURS

Row = dict[str, Any]


class Target(NamedTuple):
    """What a case is meant to reach over all scenes and sizes.

    Attributes:
        label: as printed.
        case: case of the rows; None: all of them.
        measure: "forward_backward", "forward", "memory" or "results".
        mean: the geometric mean, gsplat's time over ours (memory: ours over gsplat's; results: the memory of images and
            gradients, without which none of them can do, over gsplat's).
        single: the same for any one case.
    """

    label: str
    case: str | None
    measure: str
    mean: float | None
    single: float | None


TARGETS = (
    Target("SH RGB + 8 features at α, 8 at α_t, against two calls", "rgbt", "forward_backward", 4.0, 3.0),
    Target("D = 11", "features11", "forward_backward", 3.0, 2.0),
    Target("D = 3, SH degree 3", "rgb", "forward_backward", 2.5, 1.5),
    Target("D = 32", "features32", "forward_backward", 3.0, 2.0),
    Target("D = 8", "features8", "forward_backward", None, None),
    Target("D = 3, forward only", "rgb", "forward", 2.0, 1.3),
    Target("D = 11, forward only", "features11", "forward", None, None),
    Target("peak memory", None, "memory", 0.5, 0.8),
    Target("memory of images and gradients alone", None, "results", None, None),
)

LOW = ("memory", "results")
"""Measures of which less is better."""

FASTER_GS = {
    ("garden x1", "640x480"): (1.71, 2.20),
    ("garden x1", "1297x840"): (1.52, 2.11),
    ("garden x1", "1920x1080"): (1.52, 2.04),
    ("garden x25", "1920x1080"): (2.00, 2.32),
    ("garden x121", "1920x1080"): (1.88, 2.46),
}
"""gsplat 1.5.3's time over that of Faster-GS (CVPR 2026, CUDA) for RGB of SH degree 3, forward plus backward and
forward alone, measured on an H200 on 2026-11-20 in a run of its own."""

CPU_TARGET = 30.0
"""Geometric mean of gsplat's torch reference over ours on the CPU, forward plus backward."""


def targets_against(peer: str) -> tuple[Target, ...]:
    """The targets; for other peers than gsplat's CUDA kernels the same measures, without a goal or with the CPU's."""
    if peer == "gsplat":
        return TARGETS
    goal = CPU_TARGET if peer == "gsplat torch reference" else None
    return tuple(
        target._replace(mean=goal if target.measure == "forward_backward" else None, single=None) for target in TARGETS
    )


def ratio(row: Row, measure: str, peer: str, ours: str = OURS) -> float | None:
    """The peer's time over ours, or our memory over the peer's; None where one is missing or they disagree.

    Args:
        row: of any case.
        measure: as in ``Target``.
        peer: whom the ratio is to.
        ours: which of our own renderers, of ``ALL_OURS``.
    """
    if not row.get("apart", {}).keys().isdisjoint((peer, ours)):
        return None
    if measure == "memory":
        values = row.get("peak_memory_mib", {})
        one, other = values.get(ours), values.get(peer)
    elif measure == "results":
        one, other = row.get("results_mib"), row.get("peak_memory_mib", {}).get(peer)
    else:
        times = row.get(measure, {})
        one, other = (times.get(name, {}).get("median_ms") for name in (peer, ours))
    return one / other if one and other else None


def summary(rows: list[Row], peer: str, ours: str = OURS) -> dict[str, Any]:
    """Geometric means and worst cases beside the targets, and the comparison with Faster-GS.

    Args:
        rows: of any scenes, sizes and cases.
        peer: whom the ratios are to.
        ours: which of our own renderers.

    Returns:
        ``peer`` and ``ours``; ``targets``, one entry per target that any row belongs to, and ``faster_gs``, one per
        row that was measured there too.
    """
    entries = []
    for target in targets_against(peer):
        found = [
            (value, f"{row['scene']} {row['size']} {row['case']}")
            for row in rows
            if target.case in (None, row["case"]) and (value := ratio(row, target.measure, peer, ours)) is not None
        ]
        if not found:
            continue
        mean = math.exp(sum(math.log(value) for value, _ in found) / len(found))
        low = target.measure in LOW
        worst, where = (max if low else min)(found)
        entries.append(
            {
                "label": target.label,
                "measure": target.measure,
                "cases": len(found),
                "mean": mean,
                "mean_target": target.mean,
                "worst": worst,
                "worst_target": target.single,
                "worst_case": where,
                "reached": _reached(mean, target.mean, low) and _reached(worst, target.single, low),
            }
        )
    anchors = [
        {
            "scene": row["scene"],
            "size": row["size"],
            "forward_backward": (ratio(row, "forward_backward", peer, ours), FASTER_GS[key][0]),
            "forward": (ratio(row, "forward", peer, ours), FASTER_GS[key][1]),
        }
        for row in rows
        if peer == "gsplat" and row["case"] == "rgb" and (key := (row["scene"], row["size"])) in FASTER_GS
        if ratio(row, "forward", peer, ours) is not None
    ]
    return {"peer": peer, "ours": ours, "targets": entries, "faster_gs": anchors}


def summaries(rows: list[Row]) -> list[dict[str, Any]]:
    """The summary of each of our own renderers that was timed against every peer that was."""
    names = dict.fromkeys(name for row in rows for name in row.get("forward", {}))
    return [summary(rows, peer, ours) for peer in names if peer not in ALL_OURS for ours in ALL_OURS if ours in names]


def comparison(found: dict[str, Any]) -> str:
    """What a summary compares."""
    return f"{found['ours']} against {found['peer']}"


def _reached(value: float, target: float | None, low: bool) -> bool:
    return target is None or (value <= target if low else value >= target)


def summary_lines(found: dict[str, Any]) -> Iterable[str]:
    """The summary as a Markdown table, which reads well on a terminal too."""
    if found["targets"]:
        yield f"| {comparison(found)} | cases | geometric mean | target | worst | target | worst case | |"
        yield "|---|---|---|---|---|---|---|---|"
    for e in found["targets"]:
        signs = "<=" if e["measure"] in LOW else ">="
        goals = ["" if e[k] is None else f"{signs} {e[k]:g}" for k in ("mean_target", "worst_target")]
        verdict = "" if not any(goals) else "reached" if e["reached"] else "**missed**"
        yield (
            f"| {e['label']} | {e['cases']} | {e['mean']:.2f} | {goals[0]} | {e['worst']:.2f} | {goals[1]} "
            f"| {e['worst_case']} | {verdict} |"
        )
    if found["faster_gs"]:
        yield ""
        yield f"| {comparison(found)}, RGB, SH degree 3 | forward+backward | Faster-GS | forward | Faster-GS | |"
        yield "|---|---|---|---|---|---|"
    for e in found["faster_gs"]:
        (both, both_anchor), (forward, forward_anchor) = e["forward_backward"], e["forward"]
        ahead = "ahead" if both > both_anchor and forward > forward_anchor else "**behind**"
        yield (
            f"| {e['scene']} {e['size']} | {both:.2f} | {both_anchor:.2f} | {forward:.2f} | {forward_anchor:.2f} "
            f"| {ahead} |"
        )
