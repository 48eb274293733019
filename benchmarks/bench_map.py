"""How true are the temperatures of a map?

    python benchmarks/bench_map.py RUN... [--data FOLDER] [--gsd 0.01] [--device auto] [--json map.json]
    python benchmarks/bench_map.py RUN --truth FLIGHT --gsd 0.1

Renders a run's map as ``thermosplat-export RUN --format orthomosaic`` does, and compares it with what the held-out
images of a rendered capture measured. Each of their pixels is a point of the scene, by its true depth. A point counts
where nothing higher was seen within the same pixel of the map, and where the map shows the surface that it lies on:
the map's own depth there is the point's, within ``--within`` world units. The rest lies under something else, or on
a side that is hidden from above. README.md says more.

With ``--truth`` the map of a rendered flight is compared with FLIGHT/truth_map.npz, pixel by pixel, after the
similarity between the run's cameras and those of FLIGHT/truth.json, and after one common shift of temperature.
"""

import argparse
import json
from pathlib import Path
from typing import Any, NamedTuple

import cv2  # before pycolmap, see src/thermosplat/datasets/lens.py
import numpy as np
import torch
from numpy.typing import NDArray

from scenes.flight_truth import FlightTruth, read_flight_truth
from scenes.surface_points import surface_points
from thermosplat.datasets.capture import Capture
from thermosplat.datasets.ground_truth import read_ground_truth
from thermosplat.evaluation.loaded_run import LoadedRun, load_run
from thermosplat.export.maps.map_frame import leading_spectrum, local_frame
from thermosplat.export.maps.orthomosaic import MapGrid, render_map
from thermosplat.runs.atomic_writes import write_text
from thermosplat.runs.environment import environment
from thermosplat.spectra import unit_label

Array = NDArray[np.float64]


class Measured(NamedTuple):
    """Points that held-out images measured."""

    places: Array
    """Map coordinates: east, north, up; [P, 3]."""
    values: Array
    """In the unit of the spectrum, [P]."""


def measured_points(capture: Capture, name: str, grid: MapGrid) -> Measured:
    """Points of all held-out views of a spectrum, by their true depths."""
    places, values = [], []
    for frame in capture.test:
        truth = read_ground_truth(capture, frame)
        view = frame.views.get(name)
        if truth is None or view is None or view.values is None:
            continue
        depth = truth.depths[name].astype(np.float64)
        there = (depth > 0) & np.isfinite(view.values)
        places.append(grid.frame.to_map(surface_points(view, depth))[there])
        values.append(view.values[there].astype(np.float64))
    if not places:
        return Measured(np.zeros((0, 3)), np.zeros(0))
    return Measured(np.concatenate(places), np.concatenate(values))


def highest(points: Measured, grid: MapGrid) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Of each pixel of the map the highest point below its top: index of the point, row and column."""
    column = np.floor((points.places[:, 0] - grid.west) / grid.pixel).astype(np.intp)
    row = np.floor((grid.north - points.places[:, 1]) / grid.pixel).astype(np.intp)
    height = points.places[:, 2]
    inside = (column >= 0) & (column < grid.width) & (row >= 0) & (row < grid.height) & (height < grid.top)
    order = np.flatnonzero(inside)[np.argsort(-height[inside], kind="stable")]
    _, first = np.unique(row[order] * grid.width + column[order], return_index=True)
    chosen = order[first]
    return chosen, row[chosen], column[chosen]


@torch.no_grad()
def map_depth(loaded: LoadedRun, name: str, grid: MapGrid) -> Array:
    """Depth below the map's top [map units], [H, W]; 0 where there is nothing."""
    depth = np.zeros((grid.height, grid.width))
    for left, upper, width, height in grid.tiles():
        view = grid.view(left, upper, width, height, loaded.device)
        part = loaded.model.render_depth(name, view).cpu().numpy()
        depth[upper : upper + height, left : left + width] = part * grid.frame.scale
    return depth


def compared(loaded: LoadedRun, data: str | None, gsd: float, within: float) -> list[dict[str, Any]]:
    """A row for each spectrum of a run that measures something."""
    capture = loaded.capture(data)
    leading = leading_spectrum(capture)
    grid = MapGrid.over(local_frame(capture, leading), capture, leading, pixel=gsd)
    rows = []
    for name, scale in loaded.scales.items():
        points = measured_points(capture, name, grid)
        if scale.measured_unit is None or not len(points.values):
            continue
        picture = render_map(loaded.model, name, scale, grid, sh_degree=loaded.sh_degree)[0]
        chosen, row, column = highest(points, grid)
        values = np.clip(points.values[chosen], *scale.range) if scale.range else points.values[chosen]
        error = np.abs(picture[row, column] - values)
        depth = grid.top - points.places[chosen, 2]
        same = np.isfinite(error) & (np.abs(map_depth(loaded, name, grid)[row, column] - depth) <= within)
        rows.append(
            {
                "run": loaded.directory.path.name,
                "spectrum": name,
                "unit": unit_label(scale.measured_unit),
                "pixels": f"{grid.width}x{grid.height}",
                "compared": int(same.sum()),
                "share": float(same.mean()),
                "median": float(np.median(error[same])),
                "mean": float(error[same].mean()),
                "p95": float(np.percentile(error[same], 95)),
            }
        )
    return rows


def against_flight(loaded: LoadedRun, data: str | None, gsd: float, truth: FlightTruth) -> dict[str, float]:
    """How far the map of a flight is from the truth [m, °C]."""
    capture = loaded.capture(data)
    name = next(name for name, scale in loaded.scales.items() if scale.measured_unit is not None)
    leading = leading_spectrum(capture)
    grid = MapGrid.over(local_frame(capture, leading), capture, leading, pixel=gsd)
    picture = render_map(loaded.model, name, loaded.scales[name], grid, sh_degree=loaded.sh_degree)[0]
    east, north = np.meshgrid(
        grid.west + (np.arange(grid.width) + 0.5) * gsd, grid.north - (np.arange(grid.height) + 0.5) * gsd
    )
    height = grid.top - map_depth(loaded, leading, grid)
    places, off = truth.placed(
        capture, leading, grid.frame.to_scene(np.stack([east, north, height], -1).reshape(-1, 3))
    )
    true = truth.at(places).reshape(picture.shape)
    inside = np.isfinite(true)
    known = inside & np.isfinite(picture)
    difference = (picture - true)[known]
    shift = float(np.median(difference))
    error = np.abs(difference - shift)
    both = [np.where(known, image, true.mean(where=inside)).astype(np.float64) for image in (picture, true)]
    (right, down), _ = cv2.phaseCorrelate(*both, cv2.createHanningWindow(picture.shape[::-1], cv2.CV_64F))
    return {
        "cameras": off,
        "covered": float(known.sum() / inside.sum()),
        "shift": shift,
        "mean": float(error.mean()),
        "median": float(np.median(error)),
        "p95": float(np.percentile(error, 95)),
        "aside": float(np.hypot(right, down) * gsd),
    }


def main() -> None:
    """Compare and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", help="result folders of captures with ground truth")
    parser.add_argument("--data", help="where the capture lies now")
    parser.add_argument("--gsd", type=float, default=0.01, help="side of the map's pixels [world units]")
    parser.add_argument("--within", type=float, default=0.03, help="depths that are one surface [world units]")
    parser.add_argument("--truth", type=Path, help="folder of a rendered flight with its truth")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows = []
    if arguments.truth is not None:
        for run in arguments.runs:
            loaded = load_run(run, device=arguments.device)
            row = against_flight(loaded, arguments.data, arguments.gsd, read_flight_truth(arguments.truth))
            print(f"{loaded.directory.path.name}: " + ", ".join(f"{key} {value:.3f}" for key, value in row.items()))
        return
    print("| run | spectrum | map [px] | points compared | of the highest | median error | mean | 95% | unit |")
    print("|---|---|---|---|---|---|---|---|---|")
    for run in arguments.runs:
        loaded = load_run(run, device=arguments.device)
        for row in compared(loaded, arguments.data, arguments.gsd, arguments.within):
            print(
                f"| {row['run']} | {row['spectrum']} | {row['pixels']} | {row['compared']:,} | {row['share']:.0%} | "
                f"{row['median']:.3f} | {row['mean']:.3f} | {row['p95']:.3f} | {row['unit']} |",
                flush=True,
            )
            rows.append(row)
    if arguments.json is not None:
        report = {"environment": environment(torch.device("cpu")), "rows": rows}
        write_text(arguments.json, json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
