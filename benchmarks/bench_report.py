"""How many warm things that are known does a report find, how truly, and what does it report beside them?

    python benchmarks/bench_report.py RUN... [--data FOLDER] [--truth truth.json] [--delta K] [--device auto]

Findings are those of ``thermosplat-report RUN``. Of a rendered capture the hidden heats, glass and chrome are known by
the labels of its held-out views: a finding lies on what half of its pixels lie on. Of a flight the anomalies are known
by its truth.json. Both worlds are laid onto each other by the cameras, as GPS has errors of its own. An anomaly is
found where a finding, or a thing that the report lists, lies within 0.5 m of it. A finding is false where it lies on no
anomaly's area and not along a buried pipe.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rendered_captures.scenes.block import PIPES
from scenes.surface_points import surface_points
from thermosplat.datasets.capture import Capture
from thermosplat.datasets.ground_truth import LABELS, read_ground_truth
from thermosplat.reporting.findings import LEAST_DEGREES, Finding, Found, find
from thermosplat.thermography.hot_regions import HotPixels, find_regions
from thermosplat.viewer.layers import LayerRenderer
from thermosplat.viewer.measuring import Measurer
from thermosplat.viewer.opening import open_scene

Array = NDArray[np.float64]
_CELL = 0.06
"""[world units]; points nearer than this lie on each other."""
_NEAR, _BESIDE_PIPE = 0.5, 1.5
"""[m]; the ground above a pipe is warmer as far as the second."""


def on_labels(capture: Capture, spectrum: str, findings: list[Finding]) -> list[dict[str, Any]]:
    """A row for each labelled thing: its label, place and the findings on it."""
    points: dict[int, list[HotPixels]] = {key: [] for key in LABELS if key}
    for frame in capture.test:
        truth = read_ground_truth(capture, frame)
        if truth is None or spectrum not in frame.views:
            continue
        depth = truth.depths[spectrum].astype(np.float64)
        seen = capture.placement.to_world(surface_points(frame.views[spectrum], depth))
        for key, parts in points.items():
            there = (truth.label == key) & (depth > 0)
            parts.append(HotPixels(seen[there], np.ones(int(there.sum())), np.zeros(int(there.sum()))))
    rows = []
    for key, parts in points.items():
        everything = np.concatenate([part.points for part in parts]) if parts else np.zeros((0, 3))
        for region in find_regions(parts, _CELL):
            if region.pixels < 40:
                continue
            half = np.array(region.size) / 2 + _CELL
            mine = everything[(np.abs(everything - region.place) <= 2 * half).all(axis=1)]
            hits = [n for n, one in enumerate(findings, 1) if _share_on(one.seen.points[one.pixels], mine) >= 0.5]
            rows.append({"label": LABELS[key], "place": region.place, "findings": hits})
    return rows


def _share_on(points: Array, others: Array) -> float:
    """Share of points that lie in or beside a cell of the others."""
    cells = {tuple(cell) for cell in np.floor(others / _CELL).astype(int)}
    around = [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)]
    mine = np.floor(points / _CELL).astype(int)
    return float(np.mean([any(tuple(cell + np.array(step)) in cells for step in around) for cell in mine]))


def to_truth(capture: Capture, spectrum: str, truth: dict[str, Any]) -> Any:
    """What takes points of the world to those of truth.json: a similarity that lays cameras onto the true ones."""
    rig = np.array(truth["thermal_to_visible"])
    known = {Path(name).stem[:-2]: np.array(pose) @ rig for name, pose in truth["camera_to_world"].items()}
    ours, theirs = [], []
    for frame in (*capture.train, *capture.test):
        pose = next((pose for name, pose in known.items() if frame.name.startswith(name)), None)
        if pose is not None and spectrum in frame.views:
            ours.append(capture.placement.to_world(np.linalg.inv(frame.views[spectrum].viewmat)[:3, 3]))
            theirs.append(pose[:3, 3])
    a, b = np.array(ours), np.array(theirs)
    middle, other = a.mean(axis=0), b.mean(axis=0)
    u, s, vh = np.linalg.svd((b - other).T @ (a - middle))
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vh)]) @ vh
    scale = s.sum() / ((a - middle) ** 2).sum()
    return lambda points: scale * (np.asarray(points) - middle) @ turn.T + other


def on_anomalies(found: Found, truth: dict[str, Any], place: Any) -> tuple[list[dict[str, Any]], int]:
    """A row for each anomaly, of the nearest finding or, where none is near, thing; and how many findings are false."""
    listed = [*found.findings, *found.things]
    places = np.array([place(one.region.place)[:2] for one in listed]).reshape(-1, 2)
    rows, real = [], np.array([_along_pipes(place(one.seen.points[one.pixels])) for one in found.findings], bool)
    for anomaly in truth["anomalies"]:
        apart = np.linalg.norm(places - (anomaly["x"], anomaly["y"]), axis=1)
        of_findings = apart[: len(real)]
        real |= of_findings <= max(_NEAR, np.sqrt(anomaly["area_m2"] / 2))
        row = {"kind": anomaly["kind"], "name": anomaly["name"], "area": anomaly["area_m2"]}
        if len(apart):
            nearest = int((of_findings if (of_findings <= _NEAR).any() else apart).argmin())
            is_thing, surface = nearest >= len(real), listed[nearest].surface
            row |= {"metres": float(apart[nearest]), "found_area": surface, "is_thing": is_thing}
        rows.append(row)
    return rows, int((~real).sum())


def _along_pipes(points: Array) -> bool:
    """Whether half of points [P, 3] of the true world lie above buried pipes."""
    above = np.zeros(len(points), bool)
    for start, end in PIPES:
        along = end - start
        shares = np.clip((points[:, :2] - start) @ along / (along @ along), 0, 1)
        above |= np.linalg.norm(points[:, :2] - start - shares[:, None] * along, axis=1) <= _BESIDE_PIPE
    return float(above.mean()) >= 0.5


def main() -> None:
    """Find, compare and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", help="result folders")
    parser.add_argument("--data", help="where the capture lies now")
    parser.add_argument("--truth", type=Path, help="of a flight")
    parser.add_argument("--delta", type=float, help="the least difference; none given: as the report chooses it")
    parser.add_argument("--device", default="auto")
    arguments = parser.parse_args()
    for run in arguments.runs:
        scene, _, _ = open_scene(run, data=arguments.data, device=arguments.device)
        if scene.capture is None:
            parser.error(f"The capture of {run} is not where the run found it: --data says where it lies now.")
        measurer = Measurer(LayerRenderer(scene))
        spectrum, start = measurer.measured_spectrum(), time.monotonic()
        found = find(measurer, spectrum, limit=arguments.delta, least=LEAST_DEGREES)
        seconds = time.monotonic() - start
        findings = list(found.findings)
        print(f"{run}: {len(findings)} findings beyond {found.limit:.2f}, {found.not_read} not read, {seconds:.0f} s")
        for number, one in enumerate(findings, 1):
            print(f"  {number}: {one.difference:+.2f} at {np.round(one.region.place, 2)}, area {one.area or 0:.3g}")
        if arguments.truth is None:
            for row in on_labels(scene.capture, spectrum, findings):
                print(f"| {row['label']} | {np.round(row['place'], 2)} | {row['findings'] or 'none'} |")
            continue
        truth = json.loads(arguments.truth.read_text())
        rows, false = on_anomalies(found, truth, to_truth(scene.capture, spectrum, truth))
        for row in rows:
            near = "" if "metres" not in row else f"{row['metres']:.2f} m | {row['found_area']:.3g} m²"
            print(f"| {row['kind']} | {row['name']} | {row['area']:.3g} m² | {near} |")
        placed = [row for row in rows if row.get("metres", np.inf) <= _NEAR]
        things = sum(row["is_thing"] for row in placed)
        print(f"{len(placed)} of {len(rows)} within {_NEAR} m, {things} as a thing; {false} false", flush=True)


if __name__ == "__main__":
    main()
