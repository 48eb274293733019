"""The thermal camera beside the photographs' camera, from the scene itself: one step of preparing a capture.

Edges of the photographs become points in space (``stereo_edges``), a correlation over all frames finds where the
thermal camera looks and how strongly it magnifies (``edge_correlation``), and an alignment finishes: focal length,
principal point, distortion and pose (``edge_alignment``). Where a board was seen, lens and pose are known, and the
alignment finds the one number that is left: the scale of the scene, which becomes metric.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import cv2  # before pycolmap, see datasets/lens.py
import numpy as np
import pycolmap
from numpy.typing import NDArray

from thermosplat.errors import UserError
from thermosplat.prepare.calibration.calibration_file import RigCalibration, read_calibration
from thermosplat.prepare.capture_folder import LEADING, OTHER, CaptureFolder
from thermosplat.prepare.counted import agreeing, counted
from thermosplat.prepare.placing.place_step import place_unpaired
from thermosplat.prepare.registration.edge_alignment import STAGES, Alignment, align
from thermosplat.prepare.registration.edge_correlation import correlate
from thermosplat.prepare.registration.rig_camera import RigCamera
from thermosplat.prepare.registration.rig_model import is_photograph, with_thermal
from thermosplat.prepare.registration.stated_error import edges_deviation, photographs_deviation
from thermosplat.prepare.registration.stereo_edges import EdgePoints, photograph_edges
from thermosplat.prepare.registration.thermal_edges import mirrored, slopes
from thermosplat.prepare.registration.thermal_images import thermal_images
from thermosplat.prepare.steps import StepReport, require_step, run_step
from thermosplat.prepare.structure.sfm import write_model
from thermosplat.prepare.structure.unregistered import some

FEWEST_PAIRS = 3
EDGES_PER_FRAME = 1500
_FEWEST_EDGES = 100
"""Per frame on average; below, the photographs show next to no contours."""
ABOVE_CHANCE = 1.25
"""How many times as many edge points must meet a thermal edge as meet one by chance: 1.8 on a rendered desk."""
_UNLIKE = 0.25
"""A frame is named if edges meet above chance by less than this share of what they do in all frames together."""
_FEWEST_CHANCES = 20
"""Edge points that would meet an edge by chance, below which a thermal image shows too little to judge the pair."""
_NO_PARALLAX = 1.0
"""Largest parallax [px] from near to far that may be none: the baseline is then zero, if that fits as well."""
_AS_WELL = 0.98
"""Share of the edges' meetings that a camera without a baseline must keep."""
_AT_ONE_PLACE = tuple(
    (tuple(name for name in names if name not in ("tx", "ty", "tz")), windows) for names, windows in STAGES[1:]
)
_UNSURE = 0.02
"""Standard deviation of the photographs' focal length, as a share of it, from which on it is worth a word."""
_DEPTH = (
    "The scene has too little depth to tell it better: take photographs from other distances or at other angles, or "
    "calibrate with a board."
)
_BOARD = "Or calibrate with a board: thermosplat-prepare calibrate --help"
_TRANSLATION = (("tx", "ty", "tz"), ((12, 5.0),) * 6 + ((6, 2.0),) * 4 + ((3, 0.8),) * 6)


def register(capture: CaptureFolder) -> StepReport:
    """Find the thermal camera and write it into ``sparse/0`` as the second camera of the rig.

    Raises:
        UserError: There are too few pairs, sizes differ, images are mirrored, or the edges do not meet.
    """
    require_step(capture, "sfm")
    return run_step(
        capture,
        "register",
        lambda: _register(capture),
        settings={},
        inputs=[capture.marker("sfm"), capture.pairs_csv, capture.images(OTHER), capture.calibration_json],
        outputs=[capture.sparse / "rigs.bin"],
    )


def _register(capture: CaptureFolder) -> list[str]:
    if not capture.read_frames(OTHER):
        raise UserError(
            f"{capture.root} has no thermal images, so there is no thermal camera to register.",
            f"Photographs alone train, too: thermosplat-train {capture.root} --without thermal",
        )
    model = pycolmap.Reconstruction(capture.sparse)
    pairs = {row.rgb: row.thermal for row in capture.read_pairs()}
    if not pairs:
        return place_unpaired(capture, model)
    by_name = {
        image.name.removeprefix(f"{LEADING}/"): image
        for image in model.images.values()
        if image.has_pose and is_photograph(image)
    }
    paired = [name for name in sorted(by_name) if name in pairs]
    if len(paired) < FEWEST_PAIRS:
        raise UserError(
            f"{len(paired)} of {counted(len(pairs), 'pair')} of {capture.root} "
            f"{agreeing(len(paired), 'has', 'have')} a photograph with a pose; registering the "
            f"thermal camera needs at least {FEWEST_PAIRS}.",
            f"Look at pairs.csv, and at what thermosplat-prepare sfm {capture.root} says.",
        )
    images = [by_name[name] for name in paired]
    thermal = thermal_images(capture, [pairs[name] for name in paired])
    height, width = thermal[0].shape
    edges = photograph_edges(model, images, capture.root / "images", round(1.5 * width), EDGES_PER_FRAME)
    if len(edges.points) < _FEWEST_EDGES * len(images):
        raise UserError(
            f"The {len(images)} photographs of {capture.root} show too few contours whose depth is known "
            f"({len(edges.points):,}) to find the thermal camera by.",
            f"Take photographs in smaller steps. {_BOARD}",
        )
    fields = [slopes(image) for image in thermal]
    calibration = read_calibration(capture.calibration_json)
    if calibration is None:
        found = _from_the_scene(capture, edges, fields)
        said: list[str] = []
    else:
        metric = capture.geo_json.exists()
        found, scale = _from_a_board(calibration, edges, fields, width, height, 1.0 if metric else None)
        if not metric:
            model.transform(pycolmap.Sim3d(1 / scale, pycolmap.Rotation3d(), np.zeros(3)))
        said = [] if metric else [f"Lengths are in metres: one unit of the photographs' model was {1 / scale:.4g} m."]
        pose = calibration.thermal_from_rgb
        found_in_metres = RigCamera(pose[:3, :3], pose[:3, 3], found.camera.lens, width, height)
        found = Alignment(found_in_metres, found.deviations, found.frames)
        edges = EdgePoints(edges.frame, edges.points / scale, edges.along / scale)
    if not _fits(found):
        raise UserError(
            f"The thermal images of {capture.root} do not fit the photographs: {found.near:.0%} of the photographs' "
            f"edges meet a thermal edge, and {found.by_chance:.0%} would by chance.",
            "Are the right images paired (pairs.csv)? Contours of warm and cold things must be visible in both. "
            + _BOARD,
        )
    if calibration is None:
        said += _uncertainty(found, edges_deviation(found, edges, fields), photographs_deviation(model))
    write_model(with_thermal(model, found.camera, pairs), capture.sparse)
    return [*_findings(found, edges, paired, len(pairs)), *said]


def _uncertainty(found: Alignment, by_edges: float, by_photographs: float) -> list[str]:
    """How far the thermal focal length may be off, and what to do where the photographs do not tell it."""
    focal_length = found.camera.lens[0]
    if not math.isfinite(by_photographs):
        return [f"The photographs do not tell their focal length, and so not the thermal one. {_DEPTH}"]
    total = focal_length * math.hypot(by_edges, by_photographs)
    said = (
        f"Standard deviation of the thermal focal length: {total:.1f} px, from {by_edges:.1%} by the edges and "
        f"{by_photographs:.1%} by the focal length of the photographs."
    )
    return [f"{said} {_DEPTH}" if by_photographs > _UNSURE else said]


def _fits(found: Alignment) -> bool:
    """Whether clearly more edges meet than by chance."""
    return bool(found.frames) and found.near >= ABOVE_CHANCE * found.by_chance


def _from_the_scene(capture: CaptureFolder, edges: EdgePoints, fields: Sequence[NDArray[np.float32]]) -> Alignment:
    best, other = correlate(edges, fields)
    if best.mirrored:  # noise may look so, too, until it is aligned
        if _fits(align(best.camera, edges, [mirrored(field) for field in fields])):
            raise UserError(
                "The thermal images fit the photographs when they are mirrored.",
                f"Mirror them by the same command: thermosplat-prepare FOLDER --mirror --out {capture.root}",
            )
        best = other
    found = align(best.camera, edges, fields)
    if not found.frames or _parallax(found.camera, edges) > _NO_PARALLAX:
        return found
    at_one_place = align(replace(found.camera, translation=np.zeros(3)), edges, fields, stages=_AT_ONE_PLACE)
    return at_one_place if at_one_place.near >= _AS_WELL * found.near else found


def _parallax(camera: RigCamera, edges: EdgePoints) -> float:
    """Largest shift [px] between near and far points that the baseline makes."""
    nearest, farthest = np.percentile(edges.points[:, 2], [5, 95])
    return float(camera.lens[0] * np.linalg.norm(camera.translation) * (1 / nearest - 1 / farthest))


def _from_a_board(
    calibration: RigCalibration,
    edges: EdgePoints,
    fields: Sequence[NDArray[np.float32]],
    width: int,
    height: int,
    known_scale: float | None,
) -> tuple[Alignment, float]:
    """The calibrated camera in the units of the photographs' model, and how many of these a metre has."""
    lens = calibration.thermal
    if (lens.width, lens.height) != (width, height):
        raise UserError(
            f"calibration.json is for thermal images of {lens.width}x{lens.height} px, and these have "
            f"{width}x{height} px.",
            "Calibrate with the settings of the capture, or delete calibration.json.",
        )
    pose = calibration.thermal_from_rgb
    start = RigCamera(pose[:3, :3], np.zeros(3), np.array(lens.params), width, height)
    if known_scale is not None:
        in_place = RigCamera(start.rotation, known_scale * pose[:3, 3], start.lens, width, height)
        return align(in_place, edges, fields, stages=[]), known_scale
    free = align(start, edges, fields, stages=[_TRANSLATION])
    baseline = pose[:3, 3]
    scale = float(free.camera.translation @ baseline / (baseline @ baseline))
    deviation = float(np.linalg.norm(free.deviations[3:6]))
    if scale * np.linalg.norm(baseline) < 3 * deviation:
        raise UserError(
            "The scale of the scene cannot be found: the baseline of the calibrated cameras, "
            f"{100 * np.linalg.norm(baseline):.1f} cm, shows no parallax in these images.",
            "Delete calibration.json to register without metres, or take pictures from closer by.",
        )
    fixed = RigCamera(pose[:3, :3], scale * baseline, start.lens, width, height)
    return align(fixed, edges, fields, stages=[]), scale


def _findings(found: Alignment, edges: EdgePoints, names: Sequence[str], pairs: int) -> list[str]:
    camera = found.camera
    f, cx, cy, k1, k2 = camera.lens
    depth = float(np.median(edges.points[:, 2]))
    baseline = float(np.linalg.norm(camera.translation))
    turn = np.degrees(np.linalg.norm(cv2.Rodrigues(camera.rotation)[0]))
    said = [
        f"The thermal camera is registered in {len(names)} of {counted(pairs, 'pair')}; {found.near:.0%} of the "
        "edges of "
        f"photographs meet a thermal edge, {found.by_chance:.0%} would by chance.",
        f"Thermal lens: focal length {f:.1f} px, principal point {cx:.1f}, {cy:.1f}, distortion {k1:.3f}, {k2:.3f}.",
    ]
    if baseline == 0:
        said.append(
            f"The thermal images are aligned with the photographs except for a constant shift and scale: it looks "
            f"{turn:.2f}° aside from the same place."
        )
    else:
        said.append(f"It looks {turn:.2f}° aside, and its baseline is {baseline / depth:.1%} of the median distance.")
    plain = [names[frame] for frame, met in found.frames.items() if max(met.by_chance, met.near) < _FEWEST_CHANCES]
    if plain:
        said.append(
            f"{counted(len(plain), 'thermal image shows', 'thermal images show')} too few contours to tell whether "
            f"{agreeing(len(plain), 'it fits', 'they fit')}: {some(plain)}."
        )
    least = 1 + _UNLIKE * (found.near / max(found.by_chance, 1e-6) - 1)
    unlike = [
        names[frame]
        for frame, met in found.frames.items()
        if names[frame] not in plain and met.near < least * met.by_chance
    ]
    if unlike:
        said.append(f"{counted(len(unlike), 'pair fits', 'pairs fit')} worse than the others; look: {some(unlike)}.")
    return said
