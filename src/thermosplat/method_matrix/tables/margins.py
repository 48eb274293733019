"""By how much a method is ahead of the best other one: the claim that a comparison makes, in numbers.

ThermoSplat's paper states its margins over the second best method, and those over its ablations; each method of ours
has them here for every scene and for the mean over the scenes. A positive margin means better, also for LPIPS and °C.
"""

import statistics
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from thermosplat.method_matrix.cells import method_group
from thermosplat.method_matrix.results import Results
from thermosplat.method_matrix.tables.entries import means_over_scenes
from thermosplat.method_matrix.tables.paper import METRICS, metric_values, metrics_of
from thermosplat.method_matrix.tables.paper_numbers import FULL_METHOD, MEANS
from thermosplat.method_matrix.tables.table import Table

ALL = "all"
"""Stands for all spectra together."""
BEST_BASELINE = "best baseline"
_HIGHER_IS_BETTER = frozenset({"psnr", "ssim"})


class Duel(NamedTuple):
    """A comparison: a method against the best of its rivals, whichever that is in a column of the table."""

    method: str
    over: str
    rivals: Sequence[str]


class Margin(NamedTuple):
    """How far a method is ahead."""

    value: float
    """The difference, positive where the method is better."""
    rival: str


def margins_table(results: Results) -> Table:
    """Margins of every method that is neither baseline nor ablation, and of the full method over its ablations."""
    scenes, spectra = results.scenes(), results.spectra()
    duels = duels_of(results.methods())
    rows: list[tuple[str, ...]] = []
    for spectrum in (*spectra, ALL) if len(spectra) > 1 else spectra:
        metrics = {"psnr": METRICS["psnr"]} if spectrum == ALL else metrics_of(results, spectrum)
        for metric, (heading, form) in metrics.items():
            signed = form.replace(":", ":+")
            scores = {method: _scores(results, method, spectrum, metric) for method in results.methods()}
            for duel in duels:
                found = [
                    margin({name: scores[name][column] for name in (duel.method, *duel.rivals)}, duel, metric)
                    for column in range(len(scenes) + 1)
                ]
                if any(found):
                    texts = ["-" if one is None else signed.format(one.value) for one in found]
                    paper = _paper_margin(duel, spectra if spectrum == ALL else [spectrum], metric)
                    best = found[-1].rival if found[-1] is not None and duel.over == BEST_BASELINE else "-"
                    texts += [best, "-" if paper is None else signed.format(paper)]
                    rows.append((spectrum, heading, duel.method, duel.over, *texts))
    title = (
        "Margins, positive where the method is better; all: the mean of the spectra's PSNRs. The last columns name the "
        "best rival on the mean, and the paper's margin on its ten scenes."
    )
    columns = ("spectrum", "metric", "method", "over", *scenes, "mean", "best rival", "paper")
    return Table("margins", title, columns, tuple(rows), labels=4)


def margin(scores: Mapping[str, float | None], duel: Duel, metric: str) -> Margin | None:
    """A method's margin over the best of its rivals.

    Args:
        metric: Which metric; says whether more is better.

    Returns:
        The margin; None where the method, or all of its rivals, have no number.
    """
    sign = 1.0 if metric in _HIGHER_IS_BETTER else -1.0
    own = scores[duel.method]
    others = {name: sign * score for name in duel.rivals if (score := scores.get(name)) is not None}
    if own is None or not others:
        return None
    best = max(others, key=lambda name: others[name])
    return Margin(sign * own - others[best], best)


def duels_of(methods: Sequence[str]) -> list[Duel]:
    """Who is compared with whom."""
    baselines = [method for method in methods if method_group(method) == "baselines"]
    ablations = [method for method in methods if method_group(method) == "ablations"]
    duels = []
    for method in methods:
        if method not in (*baselines, *ablations):
            duels += [Duel(method, BEST_BASELINE, baselines)] if baselines else []
            duels += (
                [Duel(method, FULL_METHOD, [FULL_METHOD])] if FULL_METHOD in methods and method != FULL_METHOD else []
            )
    if FULL_METHOD in methods:
        duels += [Duel(FULL_METHOD, ablation, [ablation]) for ablation in ablations]
    return duels


def _scores(results: Results, method: str, spectrum: str, metric: str) -> list[float | None]:
    """A metric on every scene and its mean over them, each the mean over the seeds."""
    if spectrum == ALL:
        columns = zip(*(_scores(results, method, one, metric) for one in results.spectra()))
        return [_mean(column) for column in columns]
    by_scene = [metric_values(results, scene, method, spectrum, metric) for scene in results.scenes()]
    return [statistics.fmean(values) if values else None for values in (*by_scene, means_over_scenes(by_scene))]


def _mean(scores: Sequence[float | None]) -> float | None:
    """The mean of numbers that are all there."""
    there = [score for score in scores if score is not None]
    return statistics.fmean(there) if len(there) == len(scores) else None


def _paper_margin(duel: Duel, spectra: Sequence[str], metric: str) -> float | None:
    """The paper's margin on its means over ten scenes and over these spectra; None where it does not have them."""
    if duel.method != FULL_METHOD or metric not in METRICS or not set(spectra) <= MEANS[FULL_METHOD].keys():
        return None
    rivals = [name for name in MEANS if method_group(name) == "baselines"]
    duel = duel if duel.over != BEST_BASELINE else Duel(FULL_METHOD, BEST_BASELINE, rivals)
    scores = {
        name: statistics.fmean(getattr(means[spectrum], metric) for spectrum in spectra)
        for name, means in MEANS.items()
    }
    found = margin(scores, duel, metric)
    return None if found is None else found.value
