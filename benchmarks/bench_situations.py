"""Is the default ever worse than a simpler preset, whatever a capture is like?

    python benchmarks/bench_situations.py desk --data-factor 2 --at-once 4 --out results/situations
    python benchmarks/bench_situations.py desk --only "8 views" "two stops" --steps-scaler 0.3

Makes the situations of scenes/real_situations.py from DATA, trains every preset on each, and compares held-out PSNR.
``--steps-scaler`` shortens all of them alike; 3dgs, which has five times the steps of the others, a fifth of that. What
the default lacks beside the best of the others is in the last columns. Writes situations.json and situations.md; the
same command goes on after an interruption.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from measuring.markdown_table import markdown_table
from scenes.real_situations import SITUATIONS, situation
from thermosplat.datasets import load_capture
from thermosplat.method_matrix.processes import choose_devices
from thermosplat.runs.atomic_writes import write_text
from thermosplat.spectra import label
from training.trainings import Trainings

DEFAULT = "thermosplat_plus"
PRESETS = {
    DEFAULT: ["--config", DEFAULT],
    "fixed": ["--config", DEFAULT, "--budget", "fixed"],
    "thermosplat_fast": ["--config", "thermosplat_fast"],
    "3dgs": ["--config", "3dgs"],
}
SHORTER = {"3dgs": 0.2}
"""3dgs takes 30,000 steps, the others 4,000 to 12,000."""


def main(argv: Sequence[str] | None = None) -> int:
    """Measure what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data")
    parser.add_argument("--data-factor", type=int, default=1)
    parser.add_argument("--only", nargs="+", choices=list(SITUATIONS), default=list(SITUATIONS))
    parser.add_argument("--steps-scaler", type=float, default=1.0)
    parser.add_argument("--at-once", type=int, default=1)
    parser.add_argument("--devices", nargs="*", default=[])
    parser.add_argument("--out", type=Path, default=Path("results/situations"))
    given = parser.parse_args(argv)
    source = load_capture(given.data, data_factor=given.data_factor)
    store = given.out / "situations.json"
    found: dict[str, dict[str, dict[str, float]]] = json.loads(store.read_text()) if store.is_file() else {}
    trainings = Trainings(choose_devices(given.devices), given.at_once)
    cells = [(name, preset) for name in given.only for preset in PRESETS if preset not in found.get(name, {})]
    folders = {name: given.out / name.replace(" ", "_").replace("°", "deg") for name, _ in cells}
    for name, folder in folders.items():
        if not (folder / "capture" / "transforms.json").is_file():
            (folder / "capture").mkdir(parents=True, exist_ok=True)
            situation(source, name, folder / "capture")

    def train(cell: tuple[str, str]) -> None:
        name, preset = cell
        result = folders[name] / preset
        scaler = given.steps_scaler * SHORTER.get(preset, 1.0)
        flags = ["--result-dir", str(result), "--overwrite", "--no-tensorboard", "--steps-scaler", f"{scaler:g}"]
        try:
            values = trainings.train(result, str(folders[name] / "capture"), *PRESETS[preset], *flags)
        except RuntimeError as error:
            print(f"{name}, {preset}: {error}", file=sys.stderr, flush=True)
            return
        found.setdefault(name, {})[preset] = values
        write_text(store, json.dumps(found, indent=1))
        print(name, preset, values, flush=True)

    with ThreadPoolExecutor(trainings.count) as pool:
        list(pool.map(train, cells))
    text = table(found)
    write_text(given.out / "situations.md", text)
    print(text)
    return 0


def table(found: dict[str, dict[str, dict[str, float]]]) -> str:
    """Held-out PSNR [dB], RGB and thermal, by situation and preset, and the default's lead over the best other one.

    Args:
        found: PSNR by situation, preset and spectrum [dB].
    """
    columns = ["situation", *PRESETS, "lead RGB", "lead thermal"]
    rows = []
    for name in SITUATIONS:
        of_presets = found.get(name, {})
        cells = {preset: _numbers(values) for preset, values in of_presets.items()}
        leads = {f"lead {label(spectrum)}": _lead(of_presets, spectrum) for spectrum in ("rgb", "thermal")}
        if of_presets:
            rows.append({"situation": name, **cells, **leads})
    return markdown_table(rows, dict.fromkeys(columns, "{}"))


def _numbers(values: dict[str, float]) -> str:
    return " / ".join(f"{values[name]:.2f}" for name in ("rgb", "thermal") if name in values)


def _lead(of_presets: dict[str, dict[str, float]], spectrum: str) -> str:
    others = [values[spectrum] for preset, values in of_presets.items() if preset != DEFAULT and spectrum in values]
    own = of_presets.get(DEFAULT, {}).get(spectrum)
    return "" if own is None or not others else f"{own - max(others):+.2f}"


if __name__ == "__main__":
    sys.exit(main())
