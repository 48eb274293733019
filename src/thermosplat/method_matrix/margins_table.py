"""By how much a method is ahead of the best other one: the claim that a comparison makes, in numbers.

ThermoSplat's paper states its margins over the second best method, and those over its ablations; each method of ours
has them here for every scene and for the mean over the scenes. A positive margin means better, also for LPIPS and °C.
"""

import statistics
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

from thermosplat.datasets.capture import Modality
from thermosplat.method_matrix.cells import method_group
from thermosplat.method_matrix.paper_numbers import FULL_METHOD, MEANS
from thermosplat.method_matrix.paper_tables import CELSIUS, METRICS, MODALITIES, metric_values
from thermosplat.method_matrix.results import Results
from thermosplat.method_matrix.table_entries import means_over_scenes
from thermosplat.method_matrix.tables import Table

Spectra = Modality | Literal["both"]

BEST_BASELINE = "best baseline"
_SPECTRA: tuple[Spectra, ...] = (*MODALITIES, "both")
_HIGHER_IS_BETTER = {"psnr": True, "ssim": True, "lpips": False, "mae_celsius": False}


class Duel(NamedTuple):
    """A comparison: a method against the best of its rivals, whichever that is in a column of the table."""

    method: str
    """The method."""
    over: str
    """What to call the rivals."""
    rivals: Sequence[str]
    """The others."""


class Margin(NamedTuple):
    """How far a method is ahead."""

    value: float
    """The difference, positive where the method is better."""
    rival: str
    """The best of the others."""


def margins_table(results: Results) -> Table:
    """Margins of every method that is neither baseline nor ablation, and of the full method over its ablations."""
    scenes = results.scenes()
    duels = duels_of(results.methods())
    rows: list[tuple[str, ...]] = []
    for modality in _SPECTRA:
        metrics = {"psnr": METRICS["psnr"]} if modality == "both" else METRICS
        for metric, (label, form) in (metrics | (CELSIUS if modality == "thermal" else {})).items():
            signed = form.replace(":", ":+")
            scores = {method: _scores(results, method, modality, metric) for method in results.methods()}
            for duel in duels:
                found = [
                    margin({name: scores[name][column] for name in (duel.method, *duel.rivals)}, duel, metric)
                    for column in range(len(scenes) + 1)
                ]
                if any(found):
                    texts = ["-" if one is None else signed.format(one.value) for one in found]
                    paper = _paper_margin(duel, modality, metric)
                    best = found[-1].rival if found[-1] is not None and duel.over == BEST_BASELINE else "-"
                    texts += [best, "-" if paper is None else signed.format(paper)]
                    rows.append((modality, label, duel.method, duel.over, *texts))
    title = (
        "Margins, positive where the method is better; both: the mean of the two PSNRs. The last columns name the best "
        "rival on the mean, and the paper's margin on its ten scenes."
    )
    columns = ("modality", "metric", "method", "over", *scenes, "mean", "best rival", "paper")
    return Table("margins", title, columns, tuple(rows), labels=4)


def margin(scores: Mapping[str, float | None], duel: Duel, metric: str) -> Margin | None:
    """A method's margin over the best of its rivals.

    Args:
        scores: The metric by method.
        duel: Who is compared with whom.
        metric: Which metric; says whether more is better.

    Returns:
        The margin; None where the method, or all of its rivals, have no number.
    """
    sign = 1.0 if _HIGHER_IS_BETTER[metric] else -1.0
    own = scores[duel.method]
    others = {name: sign * score for name in duel.rivals if (score := scores.get(name)) is not None}
    if own is None or not others:
        return None
    best = max(others, key=lambda name: others[name])
    return Margin(sign * own - others[best], best)


def duels_of(methods: Sequence[str]) -> list[Duel]:
    """Who is compared with whom.

    Args:
        methods: All that there are.
    """
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


def _scores(results: Results, method: str, modality: Spectra, metric: str) -> list[float | None]:
    """A metric on every scene and its mean over them, each the mean over the seeds."""
    if modality == "both":
        pairs = zip(*(_scores(results, method, one, metric) for one in MODALITIES))
        return [None if rgb is None or thermal is None else (rgb + thermal) / 2 for rgb, thermal in pairs]
    by_scene = [metric_values(results, scene, method, modality, metric) for scene in results.scenes()]
    return [statistics.fmean(values) if values else None for values in (*by_scene, means_over_scenes(by_scene))]


def _paper_margin(duel: Duel, modality: Spectra, metric: str) -> float | None:
    """The paper's margin on its means over ten scenes."""
    if duel.method != FULL_METHOD or metric not in METRICS:
        return None
    rivals = [name for name in MEANS if method_group(name) == "baselines"]
    duel = duel if duel.over != BEST_BASELINE else Duel(FULL_METHOD, BEST_BASELINE, rivals)
    modalities = MODALITIES if modality == "both" else [one for one in MODALITIES if one == modality]
    scores = {
        name: statistics.fmean(getattr(means[one], metric) for one in modalities) for name, means in MEANS.items()
    }
    found = margin(scores, duel, metric)
    return None if found is None else found.value
