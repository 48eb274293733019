"""What do labels, feature maps and bands reach beside photographs and temperatures, and what do they cost these?

    cd benchmarks; python -m rendered_captures desk --samples 1 --out ../rendered/desk    # its labels
    python benchmarks/bench_kinds.py data/desk --labels rendered/desk/labels --only none labels features
    python benchmarks/bench_kinds.py data/lab --only none 3 31 141

Makes the captures of scenes/kinds_capture.py in OUT and trains each with CONFIG. Writes kinds.md; the same command goes
on after an interruption.
"""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from measuring.markdown_table import markdown_table
from scenes.kinds_capture import LABEL_NAMES, capture_with_bands, capture_with_features, capture_with_labels
from thermosplat.method_matrix.processes import choose_devices
from thermosplat.runs.atomic_writes import write_text
from thermosplat.runs.run_directory import RunDirectory
from training.trainings import Trainings

FEATURES, MOST_BANDS = 512, 141
KINDS = ("none", "labels", "features", "3", "31", "141")
"""What lies beside the images; numbers are of bands, of which 3 and 31 are chosen from 141."""


def main(argv: Sequence[str] | None = None) -> int:
    """Train, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--labels", type=Path, help="folder of the labels of all views")
    parser.add_argument("--only", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--config", default="thermosplat_plus")
    parser.add_argument("--at-once", type=int, default=1)
    parser.add_argument("--devices", nargs="*", default=[])
    parser.add_argument("--out", type=Path, default=Path("results/kinds"))
    given, flags = parser.parse_known_args(argv)
    if given.labels is None and {"labels", "features"} & set(given.only):
        parser.error("labels and features need --labels")
    trainings = Trainings(choose_devices(given.devices), given.at_once)

    def row(kind: str) -> dict[str, Any]:
        folder, kept = given.out / given.data.name / kind, given.out / given.data.name / f"{kind}.json"
        if not kept.is_file():
            folder.mkdir(parents=True, exist_ok=True)
            words = [str(_capture(kind, given.data, given.labels, folder / "capture")), *flags]
            config = {"base": given.config} | ({} if kind == "none" else {"spectra": _spectrum(kind)})
            write_text(folder / "config.yaml", json.dumps(config))  # JSON is YAML
            started = time.perf_counter()
            run = folder / "run"
            words += ["--config", str(folder / "config.yaml"), "--result-dir", str(run), "--overwrite"]
            trainings.train(run, *words, "--no-tensorboard")
            found = {"kind": kind, "seconds": time.perf_counter() - started}
            write_text(kept, json.dumps(found | _quality(run)))
        return json.loads(kept.read_text(encoding="utf-8"))

    with ThreadPoolExecutor(trainings.count) as pool:
        rows = list(pool.map(row, given.only))
    columns = {"kind": "{}", "rgb": "{:.2f}", "thermal": "{:.2f}", "own": "{}"}
    text = markdown_table(rows, columns | {"gaussians": "{:,}", "seconds": "{:.0f}"})
    write_text(given.out / given.data.name / "kinds.md", text)
    print(text)
    return 0


def _capture(kind: str, data: Path, labels: Path, out: Path) -> Path:
    if kind == "none":
        return data
    if kind == "labels":
        return capture_with_labels(data, labels, out)
    if kind == "features":
        return capture_with_features(data, labels, out, FEATURES)
    return capture_with_bands(data, out, MOST_BANDS, int(kind))


def _spectrum(kind: str) -> dict[str, Any]:
    """The spectrum of a kind, as configurations have it."""
    if kind == "labels":
        return {"labels": {"source": "labels", "opacity": "offset", "classes": list(LABEL_NAMES)}}
    if kind == "features":
        return {"maps": {"source": "features", "channels": FEATURES, "aligned": True}}
    return {"bands": {"source": "bands", "channels": int(kind), "aligned": True}}


def _quality(run: Path) -> dict[str, Any]:
    """PSNR of photographs and temperatures [dB], what the kind itself is judged by, and the number of Gaussians."""
    metrics = json.loads(RunDirectory(run).metrics_json.read_text(encoding="utf-8"))
    scores = ((key, metrics[name]) for name in metrics["spectra"] for key in ("miou", "cosine", "psnr_bands"))
    own = [f"{key} {of_spectrum[key]:.3f}" for key, of_spectrum in scores if key in of_spectrum]
    found = {name: metrics[name]["psnr"] for name in ("rgb", "thermal")}
    return found | {"own": ", ".join(own), "gaussians": metrics["num_gaussians"]}


if __name__ == "__main__":
    sys.exit(main())
