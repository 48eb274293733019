"""How well, and how fast, are files of two cameras prepared? How many photographs get a pose, beside COLMAP?

    python benchmarks/bench_prepare.py data/rig_desk [--photographs data/lund] [--colmap] [--out results/prepare]

Runs ``thermosplat-prepare`` on each folder, as a user does, in a process of its own. Folders after ``--photographs``
hold photographs alone. Where a folder has a truth.json (``preparation/rig_truth.py``), poses and the thermal camera are
compared with it. ``--colmap`` adds COLMAP's own reconstruction of the same photographs: features, exhaustive matching
and incremental mapping, all by default (two cores take minutes for 30 photographs). Prints a table and writes
prepare.json.
"""

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2  # noqa: F401  (before pycolmap, see src/thermosplat/datasets/lens.py)
import pycolmap

from preparation.rig_truth import rig_errors
from thermosplat.runs.atomic_writes import write_text

Row = dict[str, Any]


def prepared(folder: Path, capture: Path, *, alone: bool) -> Row:
    """Run the command from nothing and count what has a pose."""
    shutil.rmtree(capture, ignore_errors=True)
    words = ["--rgb", str(folder)] if alone else [str(folder)]
    before, started = _processor_seconds(), time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "thermosplat.cli.prepare", *words, "--out", str(capture)],
        capture_output=True,
        text=True,
        check=False,
    )
    row: Row = {"seconds": time.perf_counter() - started, "cpu_seconds": _processor_seconds() - before}
    row |= {"exit_code": done.returncode, "printed": done.stdout + done.stderr}
    row["photographs"] = len(list((capture / "images" / "rgb").glob("*")))
    if (capture / "sparse" / "0").is_dir():
        model = pycolmap.Reconstruction(capture / "sparse" / "0")
        for spectrum in ("rgb", "thermal"):
            row[spectrum] = sum(image.name.startswith(spectrum) for image in model.images.values() if image.has_pose)
        if (folder / "truth.json").is_file():
            row["errors"] = asdict(rig_errors(capture / "sparse" / "0", folder / "truth.json"))
    return row


def colmap_alone(photographs: Path) -> Row:
    """COLMAP's own reconstruction with default options: photographs in its largest model."""
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as place:
        database = Path(place) / "database.db"
        pycolmap.extract_features(database, photographs)
        pycolmap.match_exhaustive(database)
        models = pycolmap.incremental_mapping(database, photographs, Path(place))
    registered = max((model.num_reg_images() for model in models.values()), default=0)
    return {"registered": registered, "seconds": time.perf_counter() - started}


def _processor_seconds() -> float:
    """Seconds of the processor that finished child processes took."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def table(rows: Sequence[Row]) -> str:
    """The rows in Markdown."""
    heads = (
        "folder",
        "photographs with a pose",
        "thermal images with a pose",
        "seconds",
        "CPU seconds",
        "COLMAP alone",
        "its seconds",
        "rotation [°]",
        "place [% of the extent]",
        "thermal [px], median",
        "95%",
    )
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for row in rows:
        colmap, errors = row.get("colmap"), row.get("errors")
        cells = [row["folder"], f"{row.get('rgb', 0)} of {row['photographs']}", str(row.get("thermal", 0))]
        cells += [f"{row['seconds']:.0f}", f"{row['cpu_seconds']:.0f}"]
        cells += [str(colmap["registered"]), f"{colmap['seconds']:.0f}"] if colmap else ["-"] * 2
        if errors:
            cells += [f"{errors['degrees']:.3f}", f"{100 * errors['extent']:.3f}"]
            cells += [f"{errors['pixels']:.2f}", f"{errors['pixels_95']:.2f}"]
        else:
            cells += ["-"] * 4
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Measure every folder and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", type=Path, help="folders with the files of two cameras")
    parser.add_argument("--photographs", nargs="*", type=Path, default=[], help="folders with photographs alone")
    parser.add_argument("--colmap", action="store_true", help="also COLMAP's own reconstruction, by default options")
    parser.add_argument("--out", type=Path, default=Path("results/prepare"), help="where captures are made")
    arguments = parser.parse_args()
    pycolmap.logging.minloglevel = 3
    rows: list[Row] = []
    for folder, alone in [
        *((one, False) for one in arguments.folders),
        *((one, True) for one in arguments.photographs),
    ]:
        capture = arguments.out / folder.resolve().name
        row = {"folder": folder.resolve().name, **prepared(folder, capture, alone=alone)}
        if row["exit_code"]:
            print(row["printed"], file=sys.stderr)
        elif arguments.colmap:
            row["colmap"] = colmap_alone(capture / "images" / "rgb")
        rows.append(row)
        environment = {"cores": os.cpu_count(), "pycolmap": pycolmap.__version__, "command": sys.argv}
        write_text(arguments.out / "prepare.json", json.dumps({"environment": environment, "rows": rows}, indent=1))
    print(table(rows))
    if any(row["exit_code"] for row in rows):
        sys.exit(1)


if __name__ == "__main__":
    main()
