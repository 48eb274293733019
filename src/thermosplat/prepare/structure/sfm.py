"""Camera poses of the photographs: structure from motion, as one step of preparing a capture.

The database of features and matches lies in ``prepared/sfm-<digest>/``, where the digest stands for the photographs and
what is known of their cameras. An interrupted step goes on with it. The finished model lies in ``sparse/0``.
"""

import json
import shutil
from pathlib import Path

import cv2  # noqa: F401  before pycolmap, see datasets/lens.py
import pycolmap

from thermosplat.errors import UserError
from thermosplat.prepare.calibration.calibration_file import read_calibration
from thermosplat.prepare.capture_folder import LEADING, OTHER, CaptureFolder, FrameRow
from thermosplat.prepare.counted import agreeing, counted
from thermosplat.prepare.steps import StepReport, fingerprint, run_step
from thermosplat.prepare.structure.flights import remarks
from thermosplat.prepare.structure.mapping import Mapper, adjusted, map_photographs
from thermosplat.prepare.structure.matching import enter_photographs, extract, match, quiet_colmap
from thermosplat.prepare.structure.photograph_cameras import cameras_of
from thermosplat.prepare.structure.placing import Placed, placed
from thermosplat.prepare.structure.positions import positions_of
from thermosplat.prepare.structure.unregistered import reasons, some
from thermosplat.prepare.whole_files import not_written
from thermosplat.runs.atomic_writes import write_text

FEWEST_PHOTOGRAPHS = 3
"""Two photographs have a pose beside each other, but nothing confirms it."""
_RETAKE = "Take more photographs: small steps, each showing most of what the one before shows (docs/capturing.md)."


def run_sfm(capture: CaptureFolder, *, mapper: Mapper = "auto") -> StepReport:
    """Find the poses of the photographs and write ``sparse/0``.

    Args:
        mapper: COLMAP's "incremental" or "global" mapping, or "auto": global where incremental leaves many out.

    Raises:
        UserError: There are too few photographs, or they make no model; with what was found.
    """
    positions = [capture.pairs_csv] if _thermal_of(capture) else []  # a thermal image may know where its pair was
    return run_step(
        capture,
        "sfm",
        lambda: _sfm(capture, mapper),
        settings={"mapper": mapper},
        inputs=[capture.images(LEADING), capture.frames_csv, *positions, capture.calibration_json],
        outputs=[capture.sparse / "images.bin"],
    )


def write_model(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Write a COLMAP model as a folder that is there whole or not at all.

    Raises:
        UserError: It cannot be written.
    """
    temporary, old = (folder.with_name(f".{folder.name}.{kind}") for kind in ("part", "old"))
    try:
        for leftover in (temporary, old):
            shutil.rmtree(leftover, ignore_errors=True)
        temporary.mkdir(parents=True)
        model.write(temporary)
        if folder.exists():
            folder.replace(old)
        temporary.replace(folder)
        shutil.rmtree(old, ignore_errors=True)
    except OSError as error:
        raise not_written(folder, error) from error


def _sfm(capture: CaptureFolder, mapper: Mapper) -> list[str]:
    photographs = capture.read_frames(LEADING)
    count = len(photographs)
    if count < FEWEST_PHOTOGRAPHS:
        raise UserError(
            f"{capture.root} has {counted(count, 'photograph')}, and poses need at least {FEWEST_PHOTOGRAPHS}.",
            _RETAKE,
        )
    for row in photographs:
        path = capture.images(LEADING) / row.file
        if not path.is_file():  # COLMAP leaves out what is missing, and waits for a pipe without end
            raise UserError(
                f"{path} is listed in frames.csv, and there is no such file.",
                "Import the images again: thermosplat-prepare import FOLDER --out CAPTURE",
            )
    calibration = read_calibration(capture.calibration_json)
    lens = None if calibration is None else calibration.rgb
    cameras = cameras_of(photographs, lens)
    fixed = [
        number
        for number, (camera, _) in enumerate(cameras, start=1)
        if lens is not None and list(camera.params) == list(lens.params)
    ]
    positions = positions_of(photographs, _thermal_of(capture))
    work = _work_folder(capture)
    database, images = work / "database.db", capture.root / "images"
    with quiet_colmap():
        enter_photographs(database, cameras)
        extract(database, images)
        places = zip(photographs, positions.places) if positions.tell_neighbours else ()
        match(database, {row.file: place for row, place in places})
        models = map_photographs(database, images, work / "models", mapper, fixed)
        lost = reasons(database, models)
        if not models:
            raise _no_model(capture, count, lost)
        first = placed(models[0], photographs, positions)
        result = placed(adjusted(first.model, fixed, first.priors), photographs, positions)
        result.model.extract_colors_for_all_images(images)
    registered = {image.name for image in result.model.images.values() if image.has_pose}
    _write(capture, result)
    shutil.rmtree(work / "models", ignore_errors=True)
    return [*_findings(result.model, count, lost), *result.sentences, *remarks(photographs, positions, registered)]


def _thermal_of(capture: CaptureFolder) -> dict[str, FrameRow]:
    """The thermal image of each paired photograph, by the photograph's file."""
    if not capture.pairs_csv.exists():
        return {}
    thermal = {row.file: row for row in capture.read_frames(OTHER)}
    return {pair.rgb: thermal[pair.thermal] for pair in capture.read_pairs() if pair.thermal in thermal}


def _write(capture: CaptureFolder, result: Placed) -> None:
    """Write the model, and geo.json for it. At no time does the file say something of another model."""
    capture.geo_json.unlink(missing_ok=True)
    write_model(result.model, capture.sparse)
    if result.geo is not None:
        write_text(capture.geo_json, json.dumps(result.geo.content(), indent=1) + "\n")


def _work_folder(capture: CaptureFolder) -> Path:
    """The folder of the database for these photographs; those of other photographs are removed."""
    digest = fingerprint([capture.images(LEADING), capture.frames_csv, capture.calibration_json])[:12]
    work = capture.root / "prepared" / f"sfm-{digest}"
    for other in (capture.root / "prepared").glob("sfm-*"):
        if other != work and other.is_dir():
            shutil.rmtree(other, ignore_errors=True)
    try:
        work.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise not_written(work, error) from error
    return work


def _findings(model: pycolmap.Reconstruction, count: int, lost: dict[str, list[str]]) -> list[str]:
    found = [
        f"{model.num_reg_images()} of {counted(count, 'photograph')} "
        f"{agreeing(model.num_reg_images(), 'has', 'have')} a pose; "
        f"{counted(model.num_points3D(), 'point')}, "
        f"{model.compute_mean_reprojection_error():.2f} px mean reprojection error."
    ]
    for camera in model.cameras.values():
        found.append(
            f"Camera of {camera.width}x{camera.height} px: focal length {camera.mean_focal_length():.1f} px, "
            f"principal point {camera.principal_point_x:.1f}, {camera.principal_point_y:.1f}."
        )
    found += [
        f"{counted(len(names), 'photograph')} without a pose, because {why}: {some(names)}."
        for why, names in lost.items()
    ]
    return found


def _no_model(capture: CaptureFolder, count: int, lost: dict[str, list[str]]) -> UserError:
    why = "; ".join(f"{len(names)} because {reason} ({some(names)})" for reason, names in lost.items())
    return UserError(
        f"None of the {count} photographs in {capture.root} has a pose: {why}. A camera that only turns on the spot "
        "shows no depth either.",
        _RETAKE,
    )
