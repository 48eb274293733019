"""How true are the temperatures of a map?

    python benchmarks/bench_map.py RUN... [--data FOLDER] [--gsd 0.01] [--device auto] [--json map.json]

Renders a run's map as ``thermosplat-export RUN --format orthomosaic`` does, and compares it with what the held-out
images of a rendered capture measured. Each of their pixels is a point of the scene, by its true depth. A point counts
where nothing higher was seen within the same pixel of the map, and where the map shows the surface that it lies on:
the map's own depth there is the point's, within ``--within`` world units. The rest lies under something else, or on
a side that is hidden from above. README.md says more.
"""

import argparse
import json
from pathlib import Path
from typing import Any, NamedTuple

import cv2  # noqa: F401  (before pycolmap, see src/thermosplat/datasets/lens.py)
import numpy as np
import torch
from numpy.typing import NDArray

from scenes.surface_points import surface_points
from thermosplat.datasets.capture import Capture
from thermosplat.datasets.ground_truth import read_ground_truth
from thermosplat.evaluation.loaded_run import LoadedRun, load_run
from thermosplat.export.maps.map_frame import camera_centers, local_frame, map_extent
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
    leading = next(name for name in capture.spectra if any(name in frame.views for frame in capture.train))
    frame = local_frame(capture, leading)
    top = float(frame.to_map(camera_centers(capture, leading)[0])[:, 2].max())
    grid = MapGrid.covering(frame, map_extent(frame, capture), gsd, top)
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


def main() -> None:
    """Compare and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", help="result folders of captures with ground truth")
    parser.add_argument("--data", help="where the capture lies now")
    parser.add_argument("--gsd", type=float, default=0.01, help="side of the map's pixels [world units]")
    parser.add_argument("--within", type=float, default=0.03, help="depths that are one surface [world units]")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows = []
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
