"""Patterns: heat between rafters and loops of pipes come in many parts, which are one finding."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from thermosplat.reporting.warm_parts import point_of
from thermosplat.thermography.hot_regions import Region

if TYPE_CHECKING:
    from thermosplat.reporting.findings import Finding

_ALIKE = 1.4
"""Times that the differences of parts of one pattern differ."""
_ALONE = 0.75
"""Share of the square of its length from which on a region is no part of a pattern: of rafters it is the half."""


def patterns(findings: "list[Finding]", gap: float) -> "list[Finding]":
    """Findings of which neighbours that are alike are one.

    Args:
        findings: In any order.
        gap: Distance of boxes up to which they are neighbours [world units].
    """
    group = list(range(len(findings)))
    for i, one in enumerate(findings):
        for j, other in enumerate(findings[:i]):
            apart = np.abs(np.subtract(one.region.place, other.region.place))
            sizes = (np.array(one.region.size) + other.region.size) / 2
            alike = max(one.difference / other.difference, other.difference / one.difference) < _ALIKE
            between = float(np.linalg.norm(np.maximum(apart - sizes, 0)))
            if alike and between <= gap and not (_is_compact(one.region) or _is_compact(other.region)):
                group = [group[i] if number == group[j] else number for number in group]
    joined = [[one for one, of in zip(findings, group) if of == number] for number in dict.fromkeys(group)]
    return [one for some in joined for one in ([_joined(some)] if len(some) > 1 else some)]


def _is_compact(region: Region) -> bool:
    """Whether it is a thing of its own, as a module is, and no part of a pattern."""
    return region.area >= _ALONE * max(region.size) ** 2


def _joined(parts: "list[Finding]") -> "Finding":
    """Parts of a pattern as one finding, with the numbers of the largest; place and extent are those of them all."""
    largest = max(parts, key=lambda one: one.region.area)
    low, high = (
        np.array([np.add(one.region.place, sign * np.array(one.region.size) / 2) for one in parts]) for sign in (-1, 1)
    )
    ends = low.min(axis=0), high.max(axis=0)
    place, sides = point_of((ends[0] + ends[1]) / 2), point_of(ends[1] - ends[0])
    area = sum(one.region.area if one.area is None else one.area for one in parts)
    return replace(largest, region=replace(largest.region, place=place, size=sides), area=area)
