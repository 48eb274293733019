"""What does a scene lose on its way into a file for other programs?

    python benchmarks/bench_exports.py RUN... [--data FOLDER] [--device auto] [--passes N] [--formats spz ...]
                                       [--out results/exports]

Fits the splats of every spectrum of a finished run to the exact render, writes every format, reads each back by a
reader that is not ours, and renders the held-out views from what was read. Prints two tables and writes exports.json
and exports.md: the fit (PSNR of the splats against the exact render, and of both against the photographs), and the
formats (bytes, PSNR against the exact render and against the uncompressed splats). "below exact" is how much nearer the
exact render is to the photographs than the fitted splats, with its standard error over the views.
"""

import argparse
import importlib.util
import json
import math
import statistics
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2  # noqa: F401  (before pycolmap, see src/thermosplat/datasets/lens.py)
import torch
from torch import Tensor

from scenes.splat_files import READERS
from thermosplat.datasets.frame_tensors import ViewTensors, view_tensors
from thermosplat.evaluation.loaded_run import LoadedRun, load_run
from thermosplat.export.formats.splat_formats import SPLAT_FORMATS, Described, SplatFormat, write_format
from thermosplat.export.scene import spectrum_splats
from thermosplat.export.splat_fit.fitted_splats import fit_splats
from thermosplat.export.splat_rendering import render_splats
from thermosplat.export.splats import Splats
from thermosplat.image_quality.metrics import psnr
from thermosplat.novel_views.viewpoints import viewpoints
from thermosplat.runs.atomic_writes import write_text
from thermosplat.spectra import label

Rows = list[dict[str, Any]]


def mean_psnr(images: Sequence[Tensor], targets: Sequence[Tensor]) -> float:
    """PSNR [dB], the mean over the views."""
    return sum(psnr(*pair) for pair in zip(images, targets, strict=True)) / max(len(images), 1)


def below_exact(splats: Sequence[Tensor], exact: Sequence[Tensor], photographs: Sequence[Tensor]) -> str:
    """How much nearer to the photographs the exact render is than splats [dB], mean and standard error of the views."""
    losses = [
        psnr(rendered, photograph) - psnr(shown, photograph)
        for shown, rendered, photograph in zip(splats, exact, photographs, strict=True)
    ]
    if len(losses) < 2:
        return f"{losses[0]:.2f}"
    return f"{statistics.mean(losses):.2f} ± {statistics.stdev(losses) / math.sqrt(len(losses)):.2f}"


@torch.no_grad()
def rendered(splats: Splats, views: Sequence[ViewTensors], loaded: LoadedRun) -> list[Tensor]:
    """Images of splats in some views as other viewers show them, clamped."""
    moved = Splats(*(getattr(splats, name).to(loaded.device) for name in splats.__dataclass_fields__))
    return [render_splats(moved, view).clamp(0, 1) for view in views]


def measured(
    loaded: LoadedRun, data: str | None, passes: int | None, formats: Sequence[SplatFormat]
) -> tuple[Rows, Rows]:
    """Rows of the two tables for one run."""
    capture = loaded.capture(data)
    fits, files = [], []
    for name in loaded.model.spectra:
        scale = loaded.scales[name]
        train, test = (
            [point.views[name] for point in viewpoints(capture, path, [name], num_frames=1, device=loaded.device)]
            for path in ("train", "test")
        )
        photographs = [
            view_tensors(frame.views[name], None, loaded.device).image for frame in capture.test if name in frame.views
        ]
        with torch.no_grad():
            exact = [
                loaded.model.render({name: view}, sh_degree=loaded.sh_degree).images[name].clamp(0, 1) for view in test
            ]
        started = time.perf_counter()
        fit = fit_splats(loaded.model, name, scale, train, sh_degree=loaded.sh_degree, measured=test, passes=passes)
        seconds = time.perf_counter() - started
        after = rendered(fit.splats, test, loaded)
        before = rendered(spectrum_splats(loaded.model, name, loaded.scales), test, loaded)
        row: dict[str, Any] = {"scene": capture.name, "spectrum": name, "views": len(train), "seconds": seconds}
        row |= {"before_exact": fit.before, "after_exact": fit.after}
        if scale.channels == 3:  # else the splats show a palette and the photographs values
            row |= {
                "exact_photo": mean_psnr(exact, photographs),
                "below": below_exact(after, exact, photographs),
                "before_photo": mean_psnr(before, photographs),
                "after_photo": mean_psnr(after, photographs),
            }
        fits.append(row)
        print(json.dumps(row), flush=True)  # what a time limit leaves
        with tempfile.TemporaryDirectory() as folder:
            for format in formats:
                package, read = READERS[format]
                if importlib.util.find_spec(package) is None:
                    print(f"{format} is left out: {package} is not installed")
                    continue
                started = time.perf_counter()
                written = write_format(format, Path(folder), Described(fit.splats, name))
                seconds = time.perf_counter() - started
                images = rendered(read(written.path), test, loaded)
                files.append(
                    {
                        "scene": capture.name,
                        "spectrum": name,
                        "format": format,
                        "gaussians": written.num_gaussians,
                        "bytes": written.path.stat().st_size,
                        "seconds": seconds,
                        "splats_psnr": mean_psnr(images, after),
                        "exact_psnr": mean_psnr(images, exact) if scale.channels == 3 else math.nan,
                    }
                )
    return fits, files


def table(rows: Rows, columns: dict[str, tuple[str, str]]) -> str:
    """Rows as Markdown.

    Args:
        rows: What was measured.
        columns: By heading the key of a row and the form of its number; what a row lacks is a dash.
    """
    lines = [f"| {' | '.join(columns)} |", f"|{'---|' * len(columns)}"]
    for row in rows:
        cells = []
        for key, form in columns.values():
            value = row.get(key)
            if isinstance(value, float) and not math.isfinite(value):
                value = None if math.isnan(value) else value
            cells.append("-" if value is None else format(value, form))
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


FIT_COLUMNS = {
    "scene": ("scene", ""),
    "spectrum": ("label", ""),
    "views": ("views", ""),
    "splats before, to exact": ("before_exact", ".2f"),
    "splats fitted, to exact": ("after_exact", ".2f"),
    "exact, to photographs": ("exact_photo", ".2f"),
    "splats before, to photographs": ("before_photo", ".2f"),
    "splats fitted, to photographs": ("after_photo", ".2f"),
    "below exact": ("below", ""),
    "seconds": ("seconds", ".0f"),
}
FILE_COLUMNS = {
    "scene": ("scene", ""),
    "spectrum": ("label", ""),
    "format": ("format", ""),
    "Gaussians": ("gaussians", ","),
    "bytes": ("bytes", ","),
    "bytes per Gaussian": ("bytes_each", ".1f"),
    "to the splats": ("splats_psnr", ".2f"),
    "to exact": ("exact_psnr", ".2f"),
    "seconds": ("seconds", ".1f"),
}


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", metavar="RUN")
    parser.add_argument("--data")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--passes", type=int)
    parser.add_argument("--formats", nargs="*", choices=SPLAT_FORMATS, default=SPLAT_FORMATS)
    parser.add_argument("--out", type=Path, default=Path("results/exports"))
    arguments = parser.parse_args()
    fits, files = [], []
    for run in arguments.runs:
        loaded = load_run(run, device=arguments.device)
        more_fits, more_files = measured(loaded, arguments.data, arguments.passes, arguments.formats)
        fits += more_fits
        files += more_files
        for row in (*fits, *files):
            row["label"] = label(row["spectrum"])
            if "bytes" in row:
                row["bytes_each"] = row["bytes"] / max(row["gaussians"], 1)
        tables = [table(fits, FIT_COLUMNS), *([table(files, FILE_COLUMNS)] if files else [])]
        text = "\n\n".join(["PSNR [dB], the mean over the held-out views.", *tables]) + "\n"
        write_text(arguments.out / "exports.md", text)
        write_text(arguments.out / "exports.json", json.dumps({"fits": fits, "files": files}, indent=2) + "\n")
    print(text)


if __name__ == "__main__":
    main()
