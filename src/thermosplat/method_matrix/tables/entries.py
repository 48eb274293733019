"""Numbers of several cells as one entry of a table."""

import statistics
from collections.abc import Iterable


def means_over_scenes(by_scene: list[list[float]]) -> list[float]:
    """Mean over the scenes for each seed; none where a scene lacks seeds that another has."""
    counts = {len(values) for values in by_scene}
    if len(counts) != 1 or not by_scene[0]:
        return []
    return [statistics.fmean(of_seed) for of_seed in zip(*by_scene)]


def entry(values: list[float], form: str) -> str:
    """Mean over the seeds as text, with ± their standard deviation where there are several; a dash for none.

    Args:
        values: One number per seed.
        form: As ``str.format`` takes it.
    """
    if not values:
        return "-"
    text = form.format(statistics.fmean(values))
    return text if len(values) < 2 else f"{text} ± {form.format(statistics.stdev(values))}"


def known(values: Iterable[float | None]) -> list[float]:
    """The numbers that were measured."""
    return [value for value in values if value is not None]
