"""Which training views a budget looks at: those it withholds, and those it measures changes on."""

from collections.abc import Sequence

WITHHELD_ONE_IN = 10
"""At most one in so many of a spectrum's training views is withheld while Gaussians are added. Open choice."""


def validation_views(having: Sequence[Sequence[int]], count: int) -> tuple[int, ...]:
    """Frames to withhold while Gaussians are added, as ``spread``; none where these are too many of a spectrum's."""
    chosen = spread(having, count)
    return () if more_than_one_in(WITHHELD_ONE_IN, chosen, having) else chosen


def more_than_one_in(number: int, chosen: Sequence[int], having: Sequence[Sequence[int]]) -> bool:
    """Whether the chosen frames are more than one in so many of those that have some spectrum."""
    return any(number * len(set(chosen).intersection(indices)) > len(indices) for indices in having)


def spread(having: Sequence[Sequence[int]], count: int) -> tuple[int, ...]:
    """Indices of ``count`` frames of each spectrum, spread over all that have it; one frame may serve several.

    Args:
        having: Indices of the frames that have each spectrum. Captures whose cameras take turns have no frame of two.
        count: At most.
    """
    chosen: set[int] = set()
    for indices in having:
        number = min(count, len(indices))
        chosen.update(indices[round((i + 0.5) * len(indices) / number - 0.5)] for i in range(number))
    return tuple(sorted(chosen))
