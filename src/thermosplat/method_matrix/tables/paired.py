"""Margins view by view: is a difference of means more than what some views happen to show?

Two methods render the same held-out views, so their PSNRs are compared in pairs: the mean of the differences and its
standard error over the views. That leaves out what another seed would change, so a margin within it says nothing, and
one beyond it that it holds on these views for these two trainings.
"""

import math
import statistics

from thermosplat.method_matrix.results import Results
from thermosplat.method_matrix.tables.margins import duels_of
from thermosplat.method_matrix.tables.table import Table


def paired_table(results: Results) -> Table:
    """PSNR margins with their standard errors, of every comparison of ``margins_table`` with one other method."""
    scenes = results.scenes()
    rows: list[tuple[str, ...]] = []
    for spectrum in results.spectra():
        for duel in duels_of(results.methods()):
            if len(duel.rivals) == 1:
                by_scene = [differences(results, scene, duel.method, duel.rivals[0], spectrum) for scene in scenes]
                if any(by_scene):
                    rows.append((spectrum, duel.method, duel.rivals[0], *map(_entry, by_scene)))
    title = (
        "PSNR margins view by view: mean difference, positive where the method is better, ± its standard error over "
        "the held-out views (how many)."
    )
    return Table("paired", title, ("spectrum", "method", "over", *scenes), tuple(rows), labels=3)


def differences(results: Results, scene: str, method: str, rival: str, spectrum: str) -> list[float]:
    """Differences in PSNR [dB] on each held-out view, of all seeds that both have."""
    own, other = (_psnr_by_view(results, scene, name, spectrum) for name in (method, rival))
    return [own[view] - other[view] for view in own if view in other]


def _psnr_by_view(results: Results, scene: str, method: str, spectrum: str) -> dict[tuple[int, str], float]:
    return {
        (cell.seed, view["frame"]): view["psnr"]
        for cell, found in results.cells.items()
        if (cell.scene, cell.method) == (scene, method)
        for view in found.per_view
        if view["spectrum"] == spectrum and view["psnr"] is not None
    }


def _entry(values: list[float]) -> str:
    if not values:
        return "-"
    mean, count = statistics.fmean(values), len(values)
    if count == 1:
        return f"{mean:+.2f} (1)"
    return f"{mean:+.2f} ± {statistics.stdev(values) / math.sqrt(count):.2f} ({count})"
