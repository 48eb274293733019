"""How true are temperatures that were recalculated with an object's emissivity, of captures that know the truth?

    python benchmarks/bench_recalculated.py CAPTURE_OR_RUN... [--data FOLDER] [--fields FOLDER] [--json out.json]

Captures are rendered ones with scene.json, which has the emissivity and the temperature of its hidden-heat, poster and
panel objects. The apparent temperatures of held-out views are those of a run's renders, or of the capture's own thermal
images where a capture is named. Each pixel of an object counts whose true depth lies in the object's box and which is
two pixels away from other surfaces. Its temperature is recalculated with the object's emissivity and what
scene.json's room reflects, and compared with the surface's own.

Of an object that has one temperature scene.json states it. Of others it states the coldest and the hottest alone;
``--fields`` names a folder with ``<scene>.npz``, samples of their surfaces (``<object>/points``, ``<object>/celsius``),
of which the nearest is taken. Without it their medians are left out.
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from scenes.surface_points import surface_points
from thermosplat.config import TrainConfig
from thermosplat.config.temperature_settings import TemperatureSettings
from thermosplat.datasets import capture_of
from thermosplat.datasets.capture import Capture
from thermosplat.datasets.ground_truth import LABELS, read_ground_truth
from thermosplat.evaluation.held_out import rendered_views
from thermosplat.evaluation.loaded_run import LoadedRun, load_run
from thermosplat.runs.atomic_writes import write_text
from thermosplat.runs.environment import environment
from thermosplat.thermal.recalculation import Recalculation

Array = NDArray[np.float64]
KINDS = {"hidden_heat": "hidden heat", "poster": "poster"}
"""Kinds of scene.json, and their labels."""
REFLECTED = {"desk": 21.5, "lab": 22.0, "yard": 16.0}
"""[°C]: the rooms' own; before the yard's wall half is ground at 34, half sky of 9 to -22, by radiance."""
EDGE = 2
"""Pixels beside another surface, which the lens mixes with it."""
BOX = 0.01
"""Depths are rounded by a two-thousandth: objects' boxes are so much larger [m]."""


class Surface(NamedTuple):
    """What was seen of an object in all held-out views."""

    apparent: Array
    """[P] [°C]."""
    true: Array
    """[P] [°C], NaN where nobody knows."""


def apparent_views(named: str, data: str | None) -> tuple[Capture, dict[str, Array]]:
    """A capture, and apparent temperatures [°C] [H, W] of its held-out views by frame."""
    if (Path(named) / "ckpts").is_dir():
        loaded: LoadedRun = load_run(named)
        capture = loaded.capture(data)
        seen = {}
        with torch.no_grad():
            for frame in capture.test:
                for view in rendered_views(loaded.model, frame, capture.scales, loaded.sh_degree):
                    if view.values is not None:
                        seen[frame.name] = view.scale.value(view.intensity).double().cpu().numpy()
        return capture, seen
    capture = capture_of(TrainConfig(data=named))
    values = {frame.name: frame.views["thermal"].values for frame in capture.test}
    return capture, {name: value.astype(np.float64) for name, value in values.items() if value is not None}


def surfaces(capture: Capture, seen: dict[str, Array], objects: list[Any], fields: Any) -> dict[str, Surface]:
    """What was seen of each object, by its name; in several boxes a pixel is of the object whose surface is nearest."""
    numbers = {name: label for label, name in LABELS.items()}
    samples = {one["name"]: _samples(one, fields) for one in objects}
    found: dict[str, list[tuple[Array, Array]]] = {one["name"]: [] for one in objects}
    for frame in capture.test:
        truth = read_ground_truth(capture, frame)
        if truth is None or frame.name not in seen:
            continue
        points = surface_points(frame.views["thermal"], truth.depths["thermal"].astype(np.float64))
        nearest, of = np.full(truth.label.shape, np.inf), np.full(truth.label.shape, -1)
        true = np.full(truth.label.shape, np.nan)
        for number, one in enumerate(objects):
            low, high = np.array(one["bbox_min"]) - BOX, np.array(one["bbox_max"]) + BOX
            inside = (truth.label == numbers[KINDS[one["kind"]]]) & ((points >= low) & (points <= high)).all(axis=-1)
            if inside.any():
                apart, celsius = samples[one["name"]](points[inside])
                closer = np.zeros_like(inside)
                closer[inside] = apart < nearest[inside]
                nearest[closer], true[closer] = apart[closer[inside]], celsius[closer[inside]]
                of[closer] = number
        for number, one in enumerate(objects):
            kernel = np.ones((2 * EDGE + 1, 2 * EDGE + 1), np.uint8)
            inner = (cv2.erode((of == number).astype(np.uint8), kernel) > 0) & (nearest < 2 * BOX)
            if inner.any():
                found[one["name"]].append((seen[frame.name][inner], true[inner]))
    return {
        name: Surface(*(np.concatenate(parts) for parts in zip(*pieces, strict=True)))
        for name, pieces in found.items()
        if pieces
    }


def _samples(one: dict[str, Any], fields: Any) -> Callable[[Array], tuple[Array, Array]]:
    """How far places [P, 3] are from an object's surface [m], and its temperature there [°C]; NaN: nobody knows."""
    low, high = one["T_C"]
    if fields is None or f"{one['name']}/points" not in fields:
        uniform = low if high - low < 0.01 else np.nan
        return lambda places: (np.full(len(places), 1.5 * BOX), np.full(len(places), uniform))
    index = cv2.flann.Index(fields[f"{one['name']}/points"], {"algorithm": 1, "trees": 4})
    celsius = fields[f"{one['name']}/celsius"].astype(np.float64)

    def nearest(places: Array) -> tuple[Array, Array]:
        found, squares = index.knnSearch(places.astype(np.float32), 4, params={"checks": 64})
        return np.sqrt(squares[:, 0].astype(np.float64)), celsius[found].mean(axis=1)

    return nearest


def compared(named: str, data: str | None, folder: Path | None) -> list[dict[str, Any]]:
    """A row for each object of a capture."""
    capture, seen = apparent_views(named, data)
    scene = json.loads((capture.root / "scene.json").read_text())
    objects = [one for one in scene["discrepancy_objects"] if one["kind"] in KINDS]
    fields = None if folder is None else np.load(folder / f"{scene['scene']}.npz")
    rows = []
    for name, surface in surfaces(capture, seen, objects, fields).items():
        if np.isnan(surface.true).any():
            continue
        one = next(one for one in objects if one["name"] == name)
        settings = TemperatureSettings(emissivity=one["eps"], reflected=REFLECTED[scene["scene"]])
        made = Recalculation.of(None, settings).celsius(surface.apparent)
        rows.append(
            {
                "scene": scene["scene"],
                "object": name,
                "kind": KINDS[one["kind"]],
                "pixels": len(surface.true),
                "true": float(np.median(surface.true)),
                "hottest": float(np.percentile(surface.true, 99)),
                "before": float(np.median(surface.apparent - surface.true)),
                "after": float(np.median(made.celsius - surface.true)),
                "before_hot": _hot(surface.apparent, surface.true),
                "after_hot": _hot(made.celsius, surface.true),
            }
        )
    return rows


def _hot(seen: Array, true: Array) -> float:
    """Median error of the hottest tenth of a surface."""
    hottest = true >= np.percentile(true, 90)
    return float(np.median((seen - true)[hottest]))


def main() -> None:
    """Compare and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("named", nargs="+", help="rendered captures, or runs of them")
    parser.add_argument("--data", help="where the runs' capture lies now")
    parser.add_argument("--fields", type=Path, help="folder with samples of textured objects' surfaces")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows = [row for named in arguments.named for row in compared(named, arguments.data, arguments.fields)]
    print("| scene | object | kind | pixels | true | error | recalculated | error, hottest tenth | recalculated |")
    print("|---|---|---|---|---|---|---|---|---|")
    for row in rows:
        print(
            f"| {row['scene']} | {row['object']} | {row['kind']} | {row['pixels']:,} | {row['true']:.2f} | "
            f"{row['before']:+.2f} | {row['after']:+.2f} | {row['before_hot']:+.2f} | {row['after_hot']:+.2f} |"
        )
    if arguments.json is not None:
        write_text(arguments.json, json.dumps({"environment": environment(torch.device("cpu")), "rows": rows}) + "\n")


if __name__ == "__main__":
    main()
