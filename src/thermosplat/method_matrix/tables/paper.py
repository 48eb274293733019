"""The tables of ThermoSplat's paper from finished cells, with the paper's own numbers where the scenes are its own.

A number is the mean over the seeds, with ± their standard deviation where there are several. A mean over scenes exists
for a method that has them all.
"""

from collections.abc import Callable, Sequence

from thermosplat.method_matrix.cell_result import CellResult
from thermosplat.method_matrix.cells import method_group
from thermosplat.method_matrix.results import Results
from thermosplat.method_matrix.tables.entries import entry, known, means_over_scenes
from thermosplat.method_matrix.tables.paper_numbers import (
    FULL_METHOD,
    others_means,
    paper_mean,
    paper_scene,
    paper_value,
)
from thermosplat.method_matrix.tables.table import Table
from thermosplat.spectra import MAE, unit_label

METRICS = {"psnr": ("PSNR", "{:.2f}"), "ssim": ("SSIM", "{:.3f}"), "lpips": ("LPIPS", "{:.3f}")}


def all_tables(results: Results) -> list[Table]:
    """Table 1 (methods on scenes), table 2 (ablations) where there are any, and what the cells cost.

    Args:
        results: The finished cells, at least one.
    """
    ablations = [method for method in results.methods() if method_group(method) == "ablations"]
    tables = [quality_table(results)]
    if ablations:
        methods = [method for method in (*ablations, FULL_METHOD) if method in results.methods()]
        tables.append(ablation_table(results, methods))
    return [*tables, cost_table(results)]


def quality_table(results: Results) -> Table:
    """Methods on scenes: PSNR, SSIM, LPIPS of all spectra, errors of measured values: the paper's table 1."""
    scenes = results.scenes()
    methods = [method for method in results.methods() if method_group(method) != "ablations"] or results.methods()
    rows: list[tuple[str, ...]] = []
    for spectrum in results.spectra():
        for metric, (heading, form) in metrics_of(results, spectrum).items():
            for method in methods:
                ours = [metric_values(results, scene, method, spectrum, metric) for scene in scenes]
                if any(ours):
                    entries = [entry(values, form) for values in ours]
                    rows.append((spectrum, heading, method, *entries, entry(means_over_scenes(ours), form)))
                paper = [paper_value(method, spectrum, metric, scene) for scene in scenes]
                paper.append(paper_mean(method, spectrum, metric, scenes))
                if any(value is not None for value in paper):
                    rows.append((spectrum, heading, f"{method} (paper)", *(entry(_listed(v), form) for v in paper)))
            for method, value in others_means(metric, scenes).items():
                rows.append((spectrum, heading, f"{method} (paper)", *["-"] * len(scenes), form.format(value)))
    paper_note = " (paper): as ThermoSplat's paper reports it." if any(map(paper_scene, scenes)) else ""
    title = f"Table 1. Held-out views, PSNR in dB.{_lpips_note(results)}{paper_note}"
    return Table("table1", title, ("spectrum", "metric", "method", *scenes, "mean"), tuple(rows), labels=3)


def ablation_table(results: Results, methods: Sequence[str]) -> Table:
    """Means over the scenes of the full method and its ablations; the shape of the paper's table 2."""
    scenes = results.scenes()
    columns = [(spectrum, metric) for spectrum in results.spectra() for metric in METRICS]
    rows: list[tuple[str, ...]] = []
    for method in methods:
        ours = [
            means_over_scenes([metric_values(results, s, method, spectrum, metric) for s in scenes])
            for spectrum, metric in columns
        ]
        rows.append((method, *(entry(values, METRICS[metric][1]) for values, (_, metric) in zip(ours, columns))))
        paper = [paper_mean(method, spectrum, metric, scenes) for spectrum, metric in columns]
        if any(value is not None for value in paper):
            texts = [entry(_listed(value), METRICS[metric][1]) for value, (_, metric) in zip(paper, columns)]
            rows.append((f"{method} (paper)", *texts))
    headings = [f"{spectrum} {METRICS[metric][0]}" for spectrum, metric in columns]
    title = f"Table 2. Ablations, means over {len(scenes)} scene{'s' if len(scenes) > 1 else ''}.{_lpips_note(results)}"
    return Table("table2", title, ("method", *headings), tuple(rows))


def cost_table(results: Results) -> Table:
    """What every method took on every scene: Gaussians, bytes, minutes, memory, frames per second."""
    columns: dict[str, tuple[Callable[[CellResult], float | None], str]] = {
        "steps": (lambda cell: cell.steps, "{:,.0f}"),
        "Gaussians": (lambda cell: cell.num_gaussians, "{:,.0f}"),
        "model [MB]": (lambda cell: cell.model_bytes / 1e6, "{:.1f}"),
        "training [min]": (lambda cell: cell.train_minutes, "{:.1f}"),
        "peak memory [GiB]": (lambda cell: cell.peak_memory_bytes and cell.peak_memory_bytes / 2**30, "{:.2f}"),
        "frames / s": (lambda cell: cell.frames_per_second, "{:.1f}"),
    }
    rows: list[tuple[str, ...]] = []
    for scene in results.scenes():
        for method in results.methods():
            cells = results.of(scene, method)
            if cells:
                texts = [entry(known(map(read, cells)), form) for read, form in columns.values()]
                rows.append((scene, method, *texts, ", ".join(dict.fromkeys(cell.device for cell in cells))))
    title = "Cost of training, and of rendering held-out frames in all their spectra."
    return Table("cost", title, ("scene", "method", *columns, "device"), tuple(rows), labels=2)


def metrics_of(results: Results, spectrum: str) -> dict[str, tuple[str, str]]:
    """Heading and form of the metrics of a spectrum, by name."""
    measured = {
        name: (f"MAE [{unit_label(name.removeprefix(MAE))}]", "{:.3f}") for name in results.measured()[spectrum]
    }
    return METRICS | measured


def metric_values(results: Results, scene: str, method: str, spectrum: str, metric: str) -> list[float]:
    """A metric of every seed that has it."""
    cells = results.of(scene, method)
    return known((cell.spectra.get(spectrum) or {}).get(metric) for cell in cells)


def _listed(value: float | None) -> list[float]:
    return [] if value is None else [value]


def _lpips_note(results: Results) -> str:
    nets = list(dict.fromkeys(cell.lpips_net for cell in results.cells.values() if cell.lpips_net))
    return f" {'; '.join(nets)}." if nets else ""
