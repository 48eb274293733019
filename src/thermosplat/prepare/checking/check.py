"""What a capture has, and what may go wrong: in sentences, as a contact sheet and as one page."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2  # noqa: F401  before pycolmap, see datasets/lens.py
import numpy as np
import pycolmap
import yaml
from numpy.typing import NDArray

from thermosplat.datasets import load_capture
from thermosplat.datasets.colmap.model import find_model, read_model
from thermosplat.datasets.images.image_files import read_image
from thermosplat.datasets.images.spectrum_files import as_rgb
from thermosplat.datasets.parallax import Seen, parallax_remark, triangulation_angle
from thermosplat.errors import UserError
from thermosplat.evenly_chosen import evenly_chosen
from thermosplat.prepare.capture_folder import LEADING, OTHER, CaptureFolder, PairRow
from thermosplat.prepare.checking.check_page import check_page
from thermosplat.prepare.checking.contact_sheet import row, sheet, shown_thermal
from thermosplat.prepare.checking.findings import (
    Finding,
    msx_findings,
    recommended_by,
    texture_findings,
    thermal_findings,
)
from thermosplat.prepare.checking.plane_warp import PlaneWarp, read_warps
from thermosplat.prepare.checking.point_levels import PointLevels, point_levels
from thermosplat.prepare.checking.quick_check import wrong_findings
from thermosplat.prepare.checking.sensor_orientation import find_orientation, orientation_as_registered
from thermosplat.prepare.counted import agreeing, counted
from thermosplat.prepare.progress import tracked
from thermosplat.prepare.steps import StepReport, read_marker, require_step, run_step
from thermosplat.prepare.whole_files import write_png
from thermosplat.runs.atomic_writes import write_bytes
from thermosplat.spectra import COUNTS, DEFAULT_SPECTRA, label
from thermosplat.thermal.temperature_units import read_statement, to_measured

SHEET, PAGE = "contact_sheet.png", "index.html"
_ROWS = 12
"""Pairs on the contact sheet."""
_COMPARED = 16
"""Pairs whose orientation is compared."""
_MOST_PHOTOGRAPHS = 120
"""Photographs whose texture is looked at."""
_ENOUGH_REGISTERED = 0.9
_FEW_PAIRS = 20
"""Pairs below which held-out views are hardly met; RGBT-Scenes has 42 to 238 in a scene."""


def check(capture: CaptureFolder) -> StepReport:
    """Look at a capture, and write ``check/``.

    Args:
        capture: A capture of which at least the import is complete, or one of another program that can be trained on,
            into whose folder nothing is written.

    Returns:
        What was found; the last sentence is the estimate.

    Raises:
        UserError: Nothing was imported, or a file cannot be read.
    """
    if read_marker(capture, "import") is None and is_posed(capture.root):
        findings = read_findings(capture.root)
        return StepReport((*map(_line, findings), estimate_of(findings)))
    require_step(capture, "import")
    return run_step(
        capture,
        "check",
        lambda: _check(capture),
        settings={},
        inputs=[
            *(capture.marker(step) for step in ("import", "pair", "calibrate", "sfm", "register")),
            *(capture.frames_csv, capture.pairs_csv, capture.root / "sparse", capture.root / "images"),
        ],
        outputs=[capture.check / PAGE],
    )


def _check(capture: CaptureFolder) -> list[str]:
    pairs = capture.read_pairs() if capture.pairs_csv.exists() else []
    findings = [*_counts(capture, pairs), *_model_findings(capture)]
    images, unit = _thermal_values(capture)
    findings += thermal_findings(images, unit, _levels(capture, images))
    photographs = capture.read_frames(LEADING)
    chosen = photographs[:_MOST_PHOTOGRAPHS]
    read = {one.file: _photograph(capture, one.file) for one in tracked(chosen, "looking at photographs", len(chosen))}
    findings += texture_findings(read)
    if pairs:
        findings += _pair_findings(capture, pairs)
    if is_posed(capture.root):
        try:
            findings += read_findings(capture.root)
        except UserError as error:
            findings.append(Finding("warning", f"Training could not read this capture: {error.message}"))
    recommend(capture, findings)
    estimate = estimate_of(findings)
    pictures = _pictures(capture, pairs)
    if pictures:
        write_png(capture.check / SHEET, sheet([picture for _, picture in pictures]))
    write_bytes(capture.check / PAGE, check_page(capture.root.name, findings, estimate, pictures).encode())
    return [*map(_line, findings), estimate]


def _line(one: Finding) -> str:
    return f"{'! ' if one.level == 'warning' else ''}{one.sentence}"


def is_posed(root: Path) -> bool:
    """Whether a folder has camera poses, whoever made them."""
    return find_model(root) is not None or any(root.glob("transforms*.json"))


def read_findings(root: Path) -> list[Finding]:
    """What training would say of a capture before its first step, and what is probably wrong with it.

    Raises:
        UserError: It cannot be trained on.
    """
    capture = load_capture(root)
    notes = [Finding("fact", note) for note in capture.notes]
    return [*notes, *wrong_findings(capture, DEFAULT_SPECTRA)]


def recommend(capture: CaptureFolder, findings: Sequence[Finding]) -> None:
    """Write train.yaml: what helps against the findings.

    A registered camera is not refined further: it is more exact than what refining finds (docs/prepare.md).
    """
    settings = recommended_by(findings)
    if settings:
        write_bytes(capture.train_yaml, yaml.safe_dump(settings, sort_keys=True).encode())
    else:
        capture.train_yaml.unlink(missing_ok=True)


def estimate_of(findings: Sequence[Finding]) -> str:
    """How the training will go, in words."""
    warnings = [one for one in findings if one.level == "warning"]
    if not warnings:
        return "Nothing that was looked at speaks against training."
    if len(warnings) == 1:
        return "One thing will probably go wrong; it is marked above with what to do."
    return f"{len(warnings)} things will probably go wrong; they are marked above with what to do."


def _counts(capture: CaptureFolder, pairs: Sequence[PairRow]) -> list[Finding]:
    rows = capture.read_frames()
    found = []
    for spectrum in dict.fromkeys(one.spectrum for one in rows):
        group = [one for one in rows if one.spectrum == spectrum]
        sizes = sorted({(one.width, one.height) for one in group})
        shown = ", ".join(f"{width}x{height}" for width, height in sizes)
        found.append(Finding("fact", f"{counted(len(group), label(spectrum) + ' image')} of {shown} px."))
    if any(one.spectrum == OTHER for one in rows):
        if pairs:
            found.append(Finding("fact", f"{counted(len(pairs), 'pair')}."))
        elif not capture.pairs_csv.exists():
            found.append(Finding("warning", f"No pairs yet: thermosplat-prepare pair {capture.root}"))
        elif is_posed(capture.root):
            sentence = "Thermal images of another hour: training corrects their poses, as train.yaml recommends."
            found.append(Finding("fact", sentence, {"refine": ["placed"]}))
        if 0 < len(pairs) < _FEW_PAIRS:
            found.append(
                Finding("warning", f"{counted(len(pairs), 'pair is', 'pairs are')} few; take {2 * _FEW_PAIRS} or more.")
            )
    return found


def _model_findings(capture: CaptureFolder) -> list[Finding]:
    """How many images have a pose."""
    folder = find_model(capture.root)
    if folder is None:
        return [Finding("fact", f"No camera poses yet: thermosplat-prepare sfm {capture.root}")]
    model = read_model(folder)
    names = {str(image.name) for image in model.images}
    found = [Finding("fact", f"{counted(len(model.points), 'sparse point')}.")]
    cameras = [
        Seen(image.viewmat, image.lens.colmap_camera().calibration_matrix(), image.lens.width, image.lens.height)
        for image in model.images
    ]
    remark = parallax_remark(triangulation_angle(cameras, model.points))
    if remark is not None:
        found.append(Finding("warning", remark))
    for spectrum in (LEADING, OTHER):
        files = [one.file for one in capture.read_frames(spectrum)]
        posed = [file for file in files if f"{spectrum}/{file}" in names]
        if files:
            few = len(posed) < _ENOUGH_REGISTERED * len(files)
            remedy = ""
            if few and spectrum == LEADING:
                remedy = " Photographs without a pose need more overlap with the others."
            elif few:
                remedy = f" Register them: thermosplat-prepare register {capture.root}"
            every = counted(len(files), f"{label(spectrum)} image")
            sentence = f"{len(posed)} of {every} {agreeing(len(posed), 'has', 'have')} a pose.{remedy}"
            found.append(Finding("warning" if few else "fact", sentence))
    return found


def _thermal_values(capture: CaptureFolder) -> tuple[dict[str, NDArray[Any]], str | None]:
    """Thermal images by name: in °C, or as counts, or none if they are pictures."""
    rows = capture.read_frames(OTHER)
    if not rows or not capture.units_json.exists():
        return {}, None
    unit = read_statement(capture.units_json, OTHER).unit or COUNTS
    images = {}
    for one in tracked(rows, "looking at thermal images", len(rows)):
        image = read_image(capture.images(OTHER) / one.file)
        celsius = to_measured(image, unit)
        images[one.file] = image if celsius is None else celsius
    return images, "counts" if unit == COUNTS else "°C"


def _levels(capture: CaptureFolder, images: Mapping[str, NDArray[Any]]) -> PointLevels | None:
    """The levels of thermal images whose camera is registered."""
    if not images or not (capture.sparse / "rigs.bin").exists():
        return None
    return point_levels(pycolmap.Reconstruction(capture.sparse), images)


def _pair_findings(capture: CaptureFolder, pairs: Sequence[PairRow]) -> list[Finding]:
    """Orientation of the sensors, and visible edges in thermal pictures."""
    chosen = evenly_chosen(pairs, _COMPARED)
    images = [(_photograph(capture, one.rgb), read_image(capture.images(OTHER) / one.thermal)) for one in chosen]
    found = _orientation_findings(capture, chosen, images)
    measured = capture.units_json.exists() and read_statement(capture.units_json, OTHER).unit != COUNTS
    if not measured:  # MSX is drawn into pictures, not into temperatures
        found += msx_findings([(photograph, shown_thermal(thermal)) for photograph, thermal in images])
    return found


def _orientation_findings(
    capture: CaptureFolder, pairs: Sequence[PairRow], images: Sequence[tuple[NDArray[np.uint8], NDArray[Any]]]
) -> list[Finding]:
    """Thermal images that are not as their registered camera sees, or as the photographs are where none is registered.

    A registered camera may be turned, like its images, and cannot be mirrored.
    """
    folder = find_model(capture.root)
    names = [(f"{LEADING}/{one.rgb}", f"{OTHER}/{one.thermal}") for one in pairs]
    warps = {} if folder is None else read_warps(folder, names)
    if not warps:
        orientation = find_orientation(images)
        if orientation is None or orientation.upright:
            return []
        what = "look turned or mirrored against the photographs"
        return [Finding("warning", f"Thermal images {what}. Import them again with {orientation.flags}.")]
    placed = [(one, warps[name]) for one, name in zip(images, names) if name in warps]
    changed = orientation_as_registered([one for one, _ in placed], [warp for _, warp in placed])
    if changed is not None and not changed.upright:
        return [
            Finding(
                "warning",
                f"Thermal images are not as they were registered, but would be if turned by {changed.turn}°"
                f"{' and mirrored' if changed.mirror else ''}. If a program has changed them since, import them again; "
                f"then register again: thermosplat-prepare register {capture.root}",
            )
        ]
    turns = Counter(quarters(warp.thermal_from_photograph) for _, warp in placed)
    turn = 90 * turns.most_common(1)[0][0]
    if changed is None or turn == 0:
        return []
    return [
        Finding(
            "fact",
            f"Thermal images are turned by {turn}° against the photographs, and so is the registered camera: nothing "
            f"has to be done. For upright pictures import them with --turn {turn}.",
        )
    ]


def quarters(pose: NDArray[np.float64]) -> int:
    """Turn about the axis of sight in quarters, clockwise, that makes images of a camera upright.

    Args:
        pose: [4, 4] of the photograph's camera in its axes.
    """
    return round(np.degrees(np.arctan2(-pose[1, 0], pose[0, 0])) / 90) % 4


def _pictures(capture: CaptureFolder, pairs: Sequence[PairRow]) -> list[tuple[str, NDArray[np.uint8]]]:
    chosen = evenly_chosen(pairs, _ROWS)
    folder = find_model(capture.root)
    names = [(f"{LEADING}/{one.rgb}", f"{OTHER}/{one.thermal}") for one in chosen]
    warps = {} if folder is None else read_warps(folder, names)
    pictures = []
    for one, name in tracked(zip(chosen, names), "drawing pairs", len(chosen)):
        warp: PlaneWarp | None = warps.get(name)
        how = "registered, at the depth of the scene's middle" if warp else "not registered: both fill the same frame"
        thermal = shown_thermal(read_image(capture.images(OTHER) / one.thermal))
        pictures.append((f"{one.rgb} and {one.thermal} ({how})", row(_photograph(capture, one.rgb), thermal, warp)))
    return pictures


def _photograph(capture: CaptureFolder, name: str) -> NDArray[np.uint8]:
    path = capture.images(LEADING) / Path(name)
    return as_rgb(path, read_image(path))
