"""The thermal camera beside the photographs' camera, from the scene itself: one step of preparing a capture.

Edges of the photographs become points in space (``stereo_edges``), a correlation over all frames finds where the
thermal camera looks and how strongly it magnifies (``edge_correlation``), and an alignment finishes: focal length,
principal point, distortion and pose (``edge_alignment``). Where a board was seen, lens and pose are known, and the
alignment finds the one number that is left: the scale of the scene, which becomes metric.
"""

from collections import Counter
from collections.abc import Sequence

import cv2  # before pycolmap, see datasets/lens.py
import numpy as np
import pycolmap
from numpy.typing import NDArray

from thermosplat.errors import UserError
from thermosplat.prepare.calibration_file import RigCalibration, read_calibration
from thermosplat.prepare.capture_folder import LEADING, OTHER, CaptureFolder
from thermosplat.prepare.edge_alignment import Alignment, align
from thermosplat.prepare.edge_correlation import correlate
from thermosplat.prepare.progress import progress_bar
from thermosplat.prepare.rig_camera import RigCamera
from thermosplat.prepare.rig_model import is_photograph, with_thermal
from thermosplat.prepare.sfm import write_model
from thermosplat.prepare.steps import StepReport, require_step, run_step
from thermosplat.prepare.stereo_edges import EdgePoints, photograph_edges
from thermosplat.prepare.thermal_edges import slopes
from thermosplat.prepare.unregistered import some

FEWEST_PAIRS = 3
EDGES_PER_FRAME = 1500
_FEWEST_EDGES = 100
"""Per frame on average; below, the photographs show next to no contours."""
ABOVE_CHANCE = 1.25
"""How many times as many edge points must meet a thermal edge as meet one by chance: 1.8 on a rendered desk."""
_UNLIKE = 0.6
"""Share of the median agreement below which a frame is named."""
_NO_PARALLAX = 1.0
"""Largest parallax [px] that counts as a constant shift."""
_BOARD = "Or calibrate with a board: thermosplat-prepare calibrate --help"
_TRANSLATION = (("tx", "ty", "tz"), ((12, 5.0),) * 6 + ((6, 2.0),) * 4 + ((3, 0.8),) * 6)


def register(capture: CaptureFolder) -> StepReport:
    """Find the thermal camera and write it into ``sparse/0`` as the second camera of the rig.

    Args:
        capture: The capture; its photographs have poses.

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
    model = pycolmap.Reconstruction(capture.sparse)
    pairs = {row.rgb: row.thermal for row in capture.read_pairs()}
    by_name = {
        image.name.removeprefix(f"{LEADING}/"): image
        for image in model.images.values()
        if image.has_pose and is_photograph(image)
    }
    paired = [name for name in sorted(by_name) if name in pairs]
    if len(paired) < FEWEST_PAIRS:
        raise UserError(
            f"{len(paired)} of the {len(pairs)} pairs of {capture.root} have a photograph with a pose; registering the "
            f"thermal camera needs at least {FEWEST_PAIRS}.",
            f"Look at pairs.csv, and at what thermosplat-prepare sfm {capture.root} says.",
        )
    images = [by_name[name] for name in paired]
    thermal = _thermal_images(capture, [pairs[name] for name in paired])
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
        found = _from_the_scene(edges, fields, width, height)
        said: list[str] = []
    else:
        found, scale = _from_a_board(calibration, edges, fields, width, height)
        model.transform(pycolmap.Sim3d(1 / scale, pycolmap.Rotation3d(), np.zeros(3)))
        said = [f"Lengths are in metres: one unit of the photographs' model was {1 / scale:.4g} m."]
        pose = calibration.thermal_from_rgb
        found_in_metres = RigCamera(pose[:3, :3], pose[:3, 3], found.camera.lens, width, height)
        found = Alignment(found_in_metres, found.deviations, found.near, found.by_chance, found.frames)
        edges = EdgePoints(edges.frame, edges.points / scale, edges.along / scale)
    if found.near < ABOVE_CHANCE * found.by_chance or not found.frames:
        raise UserError(
            f"The thermal images of {capture.root} do not fit the photographs: {found.near:.0%} of the photographs' "
            f"edges meet a thermal edge, and {found.by_chance:.0%} would by chance.",
            "Are the right images paired (pairs.csv)? Contours of warm and cold things must be visible in both. "
            + _BOARD,
        )
    write_model(with_thermal(model, found.camera, pairs), capture.sparse)
    return [*_findings(found, edges, paired, len(pairs)), *said]


def _thermal_images(capture: CaptureFolder, names: Sequence[str]) -> list[NDArray[np.generic]]:
    """The thermal images, of one size."""
    read = []
    with progress_bar("thermal images", len(names)) as advance:
        for name in names:
            path = capture.images(OTHER) / name
            image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.is_file() else None
            if image is None:
                raise UserError(
                    f"{path} is listed in pairs.csv and cannot be read.",
                    f"Import and pair again: thermosplat-prepare pair {capture.root}",
                )
            read.append(image if image.ndim == 2 else cv2.cvtColor(image[..., :3], cv2.COLOR_BGR2GRAY))
            advance(1)
    sizes = Counter(image.shape[:2] for image in read)
    if len(sizes) > 1:
        stated = ", ".join(f"{count} of {width}x{height} px" for (height, width), count in sizes.most_common())
        raise UserError(
            f"The thermal images of {capture.root} have several sizes: {stated}. One camera has one size.",
            "Prepare a capture for each camera, or leave those of the other size out of pairs.csv.",
        )
    return read


def _from_the_scene(edges: EdgePoints, fields: Sequence[NDArray[np.float32]], width: int, height: int) -> Alignment:
    best, *_ = correlate(edges, fields)
    if best.mirrored:
        raise UserError(
            "The thermal images fit the photographs when they are mirrored.",
            "Mirror them (left to right) and import them again; some cameras have a setting for that.",
        )
    return align(best.camera, edges, fields)


def _from_a_board(
    calibration: RigCalibration, edges: EdgePoints, fields: Sequence[NDArray[np.float32]], width: int, height: int
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
    nearest, farthest = np.percentile(edges.points[:, 2], [5, 95])
    parallax = f * baseline * (1 / nearest - 1 / farthest)
    said = [
        f"The thermal camera is registered in {len(names)} of {pairs} pairs; {found.near:.0%} of the edges of "
        f"photographs meet a thermal edge, {found.by_chance:.0%} would by chance.",
        f"Thermal lens: focal length {f:.1f} px (standard deviation {f * found.deviations[6]:.2f}), principal point "
        f"{cx:.1f}, {cy:.1f}, distortion {k1:.3f}, {k2:.3f}.",
        f"It looks {turn:.2f}° aside, and its baseline is {baseline / depth:.1%} of the median distance.",
    ]
    if parallax < _NO_PARALLAX:
        said.append(
            f"The thermal images are shifted and scaled photographs: parallax is {parallax:.1f} px from near to far."
        )
    usual = float(np.median(list(found.frames.values())))
    unlike = [names[frame] for frame, share in found.frames.items() if share < _UNLIKE * usual]
    if unlike:
        said.append(f"{len(unlike)} pairs fit worse than the others; look at them: {some(unlike)}.")
    return said
