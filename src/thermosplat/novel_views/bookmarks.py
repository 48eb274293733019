"""Camera bookmarks: views that somebody found worth keeping, in a JSON file, and a camera path through them.

The file (docs/viewer.md#bookmarks):

    {"format": "thermosplat-bookmarks", "version": 1,
     "bookmarks": [{"name": "window", "viewmat": [[r, r, r, t], [r, r, r, t], [r, r, r, t], [0, 0, 0, 1]],
                    "fov_y": 42.5}]}

``viewmat`` is world-to-camera with OpenCV axes, in the world of the capture's own poses. ``fov_y`` is the vertical
field of view [degrees]; the principal point is the centre of the image, so that a bookmark fits images of any size.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.cameras import Camera
from thermosplat.datasets.placement import Placement
from thermosplat.errors import UserError
from thermosplat.novel_views.camera_paths import Matrices, interpolated_path
from thermosplat.runs.atomic_writes import write_text
from thermosplat.runs.documents import read_document

FORMAT, VERSION = "thermosplat-bookmarks", 1
FURTHEST = 1e9
"""Of a view's place [world units]: its square is still far within float32."""
FOVS = 0.1, 179.0
"""The least and the largest field of view [degrees] of a view that somebody saves."""
_RIGID = 1e-3
"""How far a rotation matrix may be from orthonormal: files that were rounded to a few digits pass."""


@dataclass(frozen=True, eq=False)
class Bookmark:
    """A view of the scene."""

    name: str
    """What its owner calls it."""
    viewmat: NDArray[np.float64]
    """World to camera, OpenCV axes, shape [4, 4]; in a viewer, from the scene's frame."""
    fov_y: float
    """Vertical field of view [degrees], in (0, 180)."""

    def in_world(self, placement: Placement) -> "Bookmark":
        """The view of a scene as files have it."""
        return replace(self, viewmat=placement.viewmat_to_world(self.viewmat))

    def in_scene(self, placement: Placement) -> "Bookmark":
        """The view of a file as it is rendered; the inverse of ``in_world``."""
        return replace(self, viewmat=placement.viewmat_to_scene(self.viewmat))


def fov_camera(fov_y: float, width: int, height: int) -> Camera:
    """The pinhole camera with square pixels and a vertical field of view, looking through the centre of its image.

    Args:
        fov_y: Vertical field of view [degrees], in (0, 180).
        width: Image width [px].
        height: Image height [px].
    """
    focal = height / (2 * math.tan(math.radians(fov_y) / 2))
    return Camera(focal, focal, width / 2, height / 2, width, height)


def write_bookmarks(path: Path, bookmarks: Sequence[Bookmark]) -> None:
    """Write a bookmarks file.

    Args:
        bookmarks: Its bookmarks, in the order of the path through them.
    """
    entries = [{"name": b.name, "viewmat": b.viewmat.tolist(), "fov_y": b.fov_y} for b in bookmarks]
    content = {"format": FORMAT, "version": VERSION, "bookmarks": entries}
    write_text(path, json.dumps(content, indent=1) + "\n")


def read_bookmarks(path: Path) -> list[Bookmark]:
    """Read a bookmarks file.

    Raises:
        UserError: It cannot be read, is something else, or a bookmark of it is not a view.
    """
    hint = "Save bookmarks in thermosplat-view, and give the file that it names."
    entries = read_document(path, "bookmarks", VERSION, hint).get("bookmarks")
    if not isinstance(entries, list) or not entries:
        raise UserError(f"{path} has no bookmarks in it.", hint)
    return [_bookmark(entry, number, path) for number, entry in enumerate(entries, 1)]


def path_through(bookmarks: Sequence[Bookmark], num_frames: int) -> list[Bookmark]:
    """A smooth path through bookmarks in their order, at constant speed; the field of view changes along with it.

    Args:
        bookmarks: At least two.
        num_frames: Views of the path, >= 1.

    Returns:
        The views, named by their number; the first and the last are the given ones.

    Raises:
        UserError: There are fewer than two bookmarks.
    """
    if len(bookmarks) < 2:
        raise UserError(
            f"A path through bookmarks needs at least two of them, found {len(bookmarks)}.",
            "Add another one in thermosplat-view.",
        )
    viewmats = np.stack([bookmark.viewmat for bookmark in bookmarks])
    path = interpolated_path(viewmats, num_frames)
    centers = np.linalg.inv(path)[:, :3, 3]
    fovs = _fovs_along(centers, np.linalg.inv(viewmats)[:, :3, 3], [bookmark.fov_y for bookmark in bookmarks])
    return [Bookmark(f"{index:05d}", viewmat, fov) for index, (viewmat, fov) in enumerate(zip(path, fovs))]


def _fovs_along(centers: Matrices, keys: Matrices, fovs: Sequence[float]) -> list[float]:
    """Fields of view of centres [F, 3] on a path past keys [B, 3]: linear in the length of the path between them."""
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(centers, axis=0), axis=1))])
    if lengths[-1] == 0:  # a camera that only turns
        lengths = np.linspace(0.0, 1.0, len(centers))
        return np.interp(lengths, np.linspace(0.0, 1.0, len(fovs)), fovs).tolist()
    passed, at = [0.0], 0
    for key in keys[1:-1]:
        at += int(np.linalg.norm(centers[at:] - key, axis=1).argmin())  # never back to an earlier passage
        passed.append(lengths[at])
    return np.interp(lengths, [*passed, lengths[-1]], fovs).tolist()


def _bookmark(entry: Any, number: int, path: Path) -> Bookmark:
    hint = "Delete that bookmark in the file, or save the bookmarks again in thermosplat-view."
    try:
        name, fov_y = str(entry["name"]), float(entry["fov_y"])
        viewmat = np.array(entry["viewmat"], np.float64)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise UserError(f"{path}: bookmark {number} lacks a name, a viewmat or a fov_y.", hint) from error
    if viewmat.shape != (4, 4) or not np.isfinite(viewmat).all():
        raise UserError(f"{path}: the viewmat of bookmark {number} is not a matrix of 4 by 4 numbers.", hint)
    if np.abs(viewmat).max() > FURTHEST:
        raise UserError(f"{path}: bookmark {number} lies further away than {FURTHEST:.0e} world units.", hint)
    rotation = viewmat[:3, :3]
    is_rotation = np.allclose(rotation @ rotation.T, np.eye(3), atol=_RIGID) and np.linalg.det(rotation) > 0
    if not is_rotation or not np.allclose(viewmat[3], [0, 0, 0, 1], atol=_RIGID):
        raise UserError(f"{path}: the viewmat of bookmark {number} is no rotation with a translation.", hint)
    if not FOVS[0] <= fov_y <= FOVS[1]:
        raise UserError(
            f"{path}: the fov_y of bookmark {number} must lie between {FOVS[0]} and {FOVS[1]:.0f} degrees.", hint
        )
    return Bookmark(name, viewmat, fov_y)
