"""Patterns: heat between rafters and loops of pipes come in many parts, which are one finding."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from thermosplat.reporting.warm_parts import point_of
from thermosplat.thermography.hot_regions import Region

if TYPE_CHECKING:
    from thermosplat.reporting.findings import Finding

_ALONE = 0.6
"""Share of the square of its length from which on a region is no part of a pattern: of rafters it is the half."""
_LONG = 0.5
"""Share of the gap between parts of a pattern that a part is long at least: a hot cell is no rafter."""


def patterns(findings: "list[Finding]", gap: float, apart: float) -> "list[Finding]":
    """Findings of which neighbours on one surface are one.

    Args:
        findings: In any order.
        gap: Distance of boxes up to which they are neighbours [world units].
        apart: Distance of references up to which they lie on one surface.
    """
    group = list(range(len(findings)))
    for i, one in enumerate(findings):
        for j, other in enumerate(findings[:i]):
            places = np.abs(np.subtract(one.region.place, other.region.place))
            sizes = (np.array(one.region.size) + other.region.size) / 2
            between = float(np.linalg.norm(np.maximum(places - sizes, 0)))
            alike = abs(one.reference - other.reference) < apart
            shorter = min(max(one.region.size), max(other.region.size))
            compact = _is_compact(one.region) or _is_compact(other.region)
            if alike and between <= gap and shorter >= _LONG * gap and not compact:
                group = [group[i] if number == group[j] else number for number in group]
    joined = [[one for one, of in zip(findings, group) if of == number] for number in dict.fromkeys(group)]
    return [one for some in joined for one in ([_joined(some)] if len(some) > 1 else some)]


def _is_compact(region: Region) -> bool:
    """Whether it is a thing of its own, as a module is, and no part of a pattern."""
    return region.area >= _ALONE * max(region.size) ** 2


def _joined(parts: "list[Finding]") -> "Finding":
    """Parts of a pattern as one finding: numbers of the largest, the extent of all, and the middle of their areas."""
    largest = max(parts, key=lambda one: one.region.area)
    low, high = (
        np.array([np.add(one.region.place, sign * np.array(one.region.size) / 2) for one in parts]) for sign in (-1, 1)
    )
    middle = np.average([one.region.place for one in parts], axis=0, weights=[one.region.area for one in parts])
    sides = high.max(axis=0) - low.min(axis=0)
    region = replace(largest.region, place=point_of(middle), size=point_of(sides))
    return replace(largest, region=region, area=sum(one.surface for one in parts))
