"""Lenses and the pose between the cameras from pictures of a board: one step of preparing a capture."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.images.image_files import list_images, read_image
from thermosplat.errors import UserError
from thermosplat.prepare.calibration.board_calibration import BoardCalibration, SeenPair, calibrate_rig
from thermosplat.prepare.calibration.boards import Board, SeenBoard, find_board, seen_checkerboard
from thermosplat.prepare.calibration.calibration_file import write_calibration
from thermosplat.prepare.capture_folder import CaptureFolder
from thermosplat.prepare.counted import counted
from thermosplat.prepare.progress import progress_bar
from thermosplat.prepare.steps import StepReport, run_step
from thermosplat.prepare.whole_files import write_png

FEWEST_BOARDS = 5
"""Pairs with a board in both images; 15 to 30 are usual."""
_SHOWN, _TILE = 6, 320
_TRIED = 4
"""Images after which a board of another size is looked for, if none of them shows the one that was stated."""
_RETAKE = (
    "Check --board, --columns and --rows (inner corners, not squares). Fill a third of both images with the board, "
    "warm it or tilt it against the sky, hold still, and take 15 to 30 pictures at several angles."
)


def calibrate(capture: CaptureFolder, rgb: Path, thermal: Path, board: Board) -> StepReport:
    """Write ``calibration.json`` and ``check/calibration.png``.

    Args:
        thermal: Folder with thermal images of the board, as many, in the same order of names.

    Raises:
        UserError: Folders do not go together, or too few boards are found; with what was found.
    """
    return run_step(
        capture,
        "calibrate",
        lambda: _calibrate(capture, rgb, thermal, board),
        settings={"board": [board.kind, board.columns, board.rows, board.size, board.marker]},
        inputs=[rgb, thermal],
        outputs=[capture.calibration_json],
    )


def _calibrate(capture: CaptureFolder, rgb: Path, thermal: Path, board: Board) -> list[str]:
    files = [list_images(folder) for folder in (rgb, thermal)]
    if len(files[0]) != len(files[1]) or not files[0]:
        raise UserError(
            f"{rgb} has {counted(len(files[0]), 'image')} and {thermal} has {len(files[1])}: one thermal image "
            "per photograph "
            "of the board is expected, in the same order.",
            "Remove what has no partner.",
        )
    images = [[read_image(path) for path in side] for side in files]
    sizes = [_size(side, folder) for side, folder in zip(images, (rgb, thermal))]
    seen: list[list[SeenBoard | None]] = [[], []]
    with progress_bar("boards", 2 * len(files[0])) as advance:
        for found, side in zip(seen, images):
            for image in side:
                found.append(find_board(image, board))
                advance(1)
                if len(found) == _TRIED and not any(found):
                    _refuse_another_size(side[:_TRIED], board)
    numbers = [k for k, both in enumerate(zip(*seen)) if all(one is not None for one in both)]
    pairs = [
        SeenPair(files[0][k].name, one, other)
        for k, (one, other) in enumerate(zip(*seen))
        if one is not None and other is not None
    ]
    if len(pairs) < FEWEST_BOARDS:
        counts = [sum(one is not None for one in found) for found in seen]
        raise UserError(
            f"The {board.kind} of {board.columns}x{board.rows} was found in {counts[0]} of {len(files[0])} "
            f"photographs, in {counts[1]} thermal images, and in both of {len(pairs)} pairs; at least {FEWEST_BOARDS} "
            "pairs are needed.",
            _RETAKE,
        )
    result = calibrate_rig(pairs, board, *sizes)
    picture = _picture([[side[k] for k in numbers] for side in images], pairs, result)
    write_png(capture.check / "calibration.png", picture)
    write_calibration(capture.calibration_json, result.rig)
    return _findings(result, pairs, len(files[0]))


def _refuse_another_size(images: Sequence[NDArray[np.generic]], board: Board) -> None:
    """Refuse to go on where the board has other numbers of corners than was stated."""
    if board.kind != "checkerboard":
        return
    sizes = Counter(size for image in images if (size := seen_checkerboard(image)) is not None)
    (columns, rows), count = max(sizes.items(), key=lambda item: item[1], default=((0, 0), 0))
    if 2 * count < len(images) or {columns, rows} == {board.columns, board.rows}:
        return
    raise UserError(
        f"The first {len(images)} images show a checkerboard of {columns}x{rows} inner corners ({count} of them), and "
        f"none of {board.columns}x{board.rows}.",
        f"Count the corners where four squares meet, not the squares: --columns {columns} --rows {rows}, or the other "
        "way round.",
    )


def _size(images: Sequence[NDArray[np.generic]], folder: Path) -> tuple[int, int]:
    """Width and height of all images [px]."""
    sizes = sorted({(image.shape[1], image.shape[0]) for image in images})
    if len(sizes) > 1:
        stated = ", ".join(f"{width}x{height}" for width, height in sizes)
        raise UserError(f"The images in {folder} have several sizes: {stated}.", "Calibrate one camera at a time.")
    return sizes[0]


def _findings(result: BoardCalibration, pairs: Sequence[SeenPair], count: int) -> list[str]:
    pose = result.rig.thermal_from_rgb
    turn = np.degrees(np.linalg.norm(cv2.Rodrigues(pose[:3, :3])[0]))
    rms = np.sqrt((result.errors**2).mean(0))
    said = [f"The board was found in both images of {len(pairs)} of {counted(count, 'pair')}."]
    for name, lens, error in zip(("Photographs", "Thermal"), (result.rig.rgb, result.rig.thermal), rms):
        f, cx, cy, k1, k2 = lens.params
        said.append(
            f"{name}: focal length {f:.1f} px, principal point {cx:.1f}, {cy:.1f}, distortion {k1:.3f}, {k2:.3f}; "
            f"{error:.2f} px root mean square reprojection error."
        )
    said.append(f"Baseline {100 * np.linalg.norm(pose[:3, 3]):.2f} cm, {turn:.2f}° between the cameras.")
    said += [
        f"{pair.name}: {errors[0]:.2f} px in the photograph, {errors[1]:.2f} px in the thermal image."
        for pair, errors in zip(pairs, result.errors)
    ]
    return said


def _picture(
    images: Sequence[Sequence[NDArray[np.generic]]], pairs: Sequence[SeenPair], result: BoardCalibration
) -> NDArray[np.uint8]:
    """RGB picture with the pairs that fit worst: both images with the corners that were found."""
    rows = []
    for k in np.argsort(-result.errors.max(1))[:_SHOWN]:
        tiles = []
        for side, seen in ((0, pairs[k].rgb), (1, pairs[k].thermal)):
            grey = images[side][k] if images[side][k].ndim == 2 else images[side][k].mean(2)
            low, high = np.percentile(grey, [1, 99])
            levels = np.clip((grey - low) * (255 / max(high - low, 1e-6)), 0, 255).astype(np.uint8)
            scale = _TILE / levels.shape[1]
            tile = cv2.cvtColor(cv2.resize(levels, (_TILE, round(levels.shape[0] * scale))), cv2.COLOR_GRAY2RGB)
            for x, y in (seen.pixels + 0.5) * scale:
                cv2.circle(tile, (round(float(x)), round(float(y))), 2, (0, 230, 90), -1, cv2.LINE_AA)
            text = f"{pairs[k].name}  {result.errors[k, side]:.2f} px"
            cv2.putText(tile, text, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 200, 0), 1, cv2.LINE_AA)
            tiles.append(tile)
        height = max(tile.shape[0] for tile in tiles)
        rows.append(
            np.hstack([cv2.copyMakeBorder(t, 0, height - t.shape[0], 0, 0, cv2.BORDER_CONSTANT) for t in tiles])
        )
    return np.vstack(rows)
