"""Calibration boards in pictures of either spectrum: their corners or circles, whichever side is warm.

Positions in images count from the first pixel's centre, as OpenCV does; ``calibrate`` changes that.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

BoardKind = Literal["checkerboard", "circles", "charuco"]
_DICTIONARY = cv2.aruco.DICT_5X5_100
_DETECTION_WIDTH = 640
"""Smaller images are enlarged to at least this width [px], where detectors work better."""
_LARGEST_SIDE = 1200
"""Checkerboards are looked for at most at this size [px], where corners are good to a tenth of a pixel: a photograph of
4 megapixels took 15 s, one of 12 megapixels a minute."""
_FEWEST_CORNERS = 8
"""Of a ChArUco board, which need not be seen as a whole."""

_WINDOW = 6
"""Half the window [px] in which corners of a ChArUco board are refined."""
_EXACT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-4)


@dataclass(frozen=True)
class Board:
    """What is printed, cut or etched on the board.

    Args:
        kind: "checkerboard", "circles" (asymmetric grid) or "charuco" (dictionary 5X5_100).
        columns: Inner corners per row, or circles per row; squares per row of a ChArUco board.
        rows: Rows of these.
        size: Side of a square, or the distance between diagonal neighbours' columns of circles [m].
        marker: Side of a ChArUco marker [m].
    """

    kind: BoardKind
    columns: int
    rows: int
    size: float
    marker: float = 0.0

    def points(self) -> NDArray[np.float32]:
        """[N, 3] where corners or circles are on the board [m]."""
        if self.kind == "charuco":
            return np.asarray(self.charuco().getChessboardCorners(), np.float32)
        row, column = np.divmod(np.arange(self.rows * self.columns), self.columns)
        x = 2 * column + row % 2 if self.kind == "circles" else column
        return np.column_stack([x, row, np.zeros_like(row)]).astype(np.float32) * np.float32(self.size)

    def charuco(self) -> cv2.aruco.CharucoBoard:
        """The board for OpenCV's detector."""
        dictionary = cv2.aruco.getPredefinedDictionary(_DICTIONARY)
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.size, self.marker, dictionary)


@dataclass(frozen=True, eq=False)
class SeenBoard:
    """A board in an image.

    Args:
        ids: [N] which of ``Board.points``.
        pixels: [N, 2] float32 where they are [px, the first pixel's centre is 0].
    """

    ids: NDArray[np.int64]
    pixels: NDArray[np.float32]


def find_board(image: NDArray[np.generic], board: Board) -> SeenBoard | None:
    """The board in an image, or None.

    Args:
        image: [H, W] or [H, W, 3] (RGB) values in any unit.
        board: What to look for. Dark may be light and light dark: both are tried.
    """
    scale = _scale(image, board.kind)
    for picture in _pictures(image, scale):
        found = _detect(picture, board)
        if found is not None:
            ids, pixels = found
            return SeenBoard(ids, ((pixels + 0.5) / scale - 0.5).astype(np.float32))
    return None


def seen_checkerboard(image: NDArray[np.generic]) -> tuple[int, int] | None:
    """Columns and rows of inner corners of the largest checkerboard in an image, the longer side first; None for none.

    Args:
        image: [H, W] or [H, W, 3] values in any unit.
    """
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
    sizes = []
    for picture in _pictures(image, _scale(image, "checkerboard")):
        done, _, meta = cv2.findChessboardCornersSBWithMeta(picture, (3, 3), flags)
        if done:
            sizes.append((max(meta.shape[:2]), min(meta.shape[:2])))
    return max(sizes, key=lambda size: size[0] * size[1], default=None)


def _scale(image: NDArray[np.generic], kind: BoardKind) -> float:
    """How much an image is enlarged for the detection."""
    if kind == "checkerboard" and max(image.shape[:2]) > _LARGEST_SIDE:
        return _LARGEST_SIDE / max(image.shape[:2])
    return max(1, -(-_DETECTION_WIDTH // image.shape[1]))


def _pictures(image: NDArray[np.generic], scale: float) -> Iterator[NDArray[np.uint8]]:
    """The image in grey levels, then its negative."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    low, high = np.percentile(grey, [1, 99])
    levels = np.clip((grey.astype(np.float32) - low) * (255 / max(float(high - low), 1e-6)), 0, 255).astype(np.uint8)
    if scale != 1:
        how = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
        levels = cv2.resize(levels, None, fx=scale, fy=scale, interpolation=how)
    yield levels
    yield 255 - levels


def _detect(picture: NDArray[np.uint8], board: Board) -> tuple[NDArray[np.int64], NDArray[np.float32]] | None:
    if board.kind == "charuco":
        corners, ids, _, _ = cv2.aruco.CharucoDetector(board.charuco()).detectBoard(picture)
        if ids is None or len(ids) < _FEWEST_CORNERS:
            return None
        corners = cv2.cornerSubPix(picture, np.float32(corners), (_WINDOW, _WINDOW), (-1, -1), _EXACT)
        return ids.reshape(-1).astype(np.int64), corners.reshape(-1, 2)
    grid = (board.columns, board.rows)
    if board.kind == "circles":
        done, pixels = cv2.findCirclesGrid(picture, grid, flags=cv2.CALIB_CB_ASYMMETRIC_GRID)
    else:
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
        done, pixels = cv2.findChessboardCornersSB(picture, grid, flags=flags)
    return (np.arange(board.columns * board.rows), pixels.reshape(-1, 2)) if done else None
