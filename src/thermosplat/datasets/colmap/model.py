"""COLMAP sparse models: where they lie in a capture, and what is read from them."""

import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory

import cv2  # noqa: F401  before pycolmap, see lens.py
import numpy as np
import pycolmap
from numpy.typing import NDArray

from thermosplat.datasets.cameras import camera_center
from thermosplat.datasets.colmap.record_lengths import Damage, wrong_lengths
from thermosplat.datasets.colmap.text_model import write_plain
from thermosplat.datasets.images.image_folders import describe_folder
from thermosplat.datasets.lens import Lens
from thermosplat.datasets.random_points import MIN_POINTS, STARTING_RANDOM, random_points, starting_places
from thermosplat.errors import UserError

MODEL_FOLDERS = ("sparse/0", "colmap/sparse/0", "sparse", "colmap/sparse")
"""Where a model is looked for; RGBT-Scenes is downloaded with the second and documented with the first."""
_MIN_REGISTERED_SHARE = 0.1


@dataclass(frozen=True, eq=False)
class RegisteredImage:
    """An image with a pose in a COLMAP model.

    Args:
        name: Path of the image relative to the folder COLMAP was run on.
        viewmat: [4, 4] float64, world to camera.
        frame_id: COLMAP's rig frame: images of one exposure of a camera rig share it.
    """

    name: PurePosixPath
    lens: Lens
    viewmat: NDArray[np.float64]
    frame_id: int


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """Registered images by name, and sparse points: [M, 3] float64 with colours [M, 3] uint8."""

    folder: Path
    images: tuple[RegisteredImage, ...]
    points: NDArray[np.float64]
    point_colors: NDArray[np.uint8]


def find_model(root: Path) -> Path | None:
    """Folder of the capture's COLMAP model, or None."""
    for folder in MODEL_FOLDERS:
        if any((root / folder / f"cameras.{kind}").is_file() for kind in ("bin", "txt")):
            return root / folder
    return None


def read_model(folder: Path) -> ColmapModel:
    """Read a COLMAP model, binary or text.

    Raises:
        UserError: Files are missing or damaged, two images have one name, or a rotation is zero.
    """
    model, names = _reconstruction(folder)
    lenses = {camera_id: Lens.from_colmap(camera) for camera_id, camera in model.cameras.items()}
    images = []
    for number, image in model.images.items():
        if image.has_pose:
            name = _name(image, names.get(number), folder)
            images.append(RegisteredImage(name, lenses[image.camera_id], _viewmat(image, name, folder), image.frame_id))
    _check_named_once(images, folder)
    points = list(model.points3D.values())
    return ColmapModel(
        folder,
        tuple(sorted(images, key=lambda image: image.name)),
        np.array([point.xyz for point in points], np.float64).reshape(-1, 3),
        np.array([point.color for point in points], np.uint8).reshape(-1, 3),
    )


def check_reconstruction(model: ColmapModel, files: int, root: Path) -> None:
    """Refuse a model that covers next to nothing of the capture, or whose points are better in another one beside it.

    Args:
        files: Image files in the capture that could be in the model.

    Raises:
        UserError: Too few registered images, or no points where a sibling model has more images; the hint names the
            largest sibling model, if that is better.
    """
    registered, points = len(model.images), len(model.points)
    enough = registered >= max(2, _MIN_REGISTERED_SHARE * files)
    if enough and points >= MIN_POINTS:
        return
    where = model.folder.relative_to(root)
    message = f"The model in {where} of {root} has {registered} registered of {files} images and {points:,} points."
    siblings = {
        folder: _registered(folder)
        for folder in sorted(model.folder.parent.iterdir())
        if folder != model.folder and any((folder / f"images.{kind}").is_file() for kind in ("bin", "txt"))
    }
    best = max(siblings, key=lambda folder: siblings[folder], default=None)
    if best is not None and siblings[best] > registered:
        raise UserError(
            message, f"{best.relative_to(root)} has {siblings[best]} images: put its files into {where} instead."
        )
    if not enough:
        raise UserError(message, "Photographs need more overlap, or run colmap mapper again with all of them.")


def with_points(model: ColmapModel) -> tuple[ColmapModel, list[str]]:
    """The model, with random points and a note if it has none to start from: poses may come from elsewhere."""
    centers = np.array([camera_center(image.viewmat) for image in model.images])
    centers = centers[np.isfinite(centers).all(axis=-1)]
    places, found = starting_places(model.points), len(model.points)
    if places >= MIN_POINTS or not len(centers):
        return model, []
    points, colors = random_points(centers)
    where = "" if found < MIN_POINTS else f" in {places} places"
    note = f"The COLMAP model in {model.folder} has {found:,} points{where}: {STARTING_RANDOM}"
    return replace(model, points=points, point_colors=colors), [note]


def missing_model(root: Path) -> UserError:
    """The error for a capture, in the folder ``root``, with images and without a model."""
    found = ", ".join(describe_folder(folder) for folder in sorted(root.iterdir()) if folder.is_dir()) or "no folders"
    message = (
        f"No COLMAP model in {root}. Looked for cameras.bin or cameras.txt in: {', '.join(MODEL_FOLDERS)}. "
        f"Found: {found}."
    )
    if (root / "prepared").is_dir():
        return UserError(message, f"Go on with its preparation: thermosplat-prepare sfm {shlex.quote(str(root))}")
    return UserError(
        message,
        "The untouched files of cameras become a capture, poses and all, with "
        f"thermosplat-prepare {shlex.quote(str(root))}",
    )


def _reconstruction(folder: Path) -> tuple[pycolmap.Reconstruction, dict[int, str]]:
    """The model, and of a text model the names of its images by their numbers."""
    # on missing files, and on binary ones that their records do not fill, some pycolmap hangs or takes all memory
    damage = _special(folder) or _missing(folder) or wrong_lengths(folder)
    remedy = "Make the model again (colmap mapper), or copy all its files."
    error: Exception | None = None
    if damage is None:
        try:
            if all((folder / f"{name}.bin").is_file() for name in _NEEDED):  # those pycolmap prefers to text
                return pycolmap.Reconstruction(folder), {}
            with TemporaryDirectory() as plain:
                names = write_plain(folder, Path(plain))
                return pycolmap.Reconstruction(plain), names
        except Damage as found:
            damage, remedy = str(found), "Correct that line, or write the model again (colmap model_converter)."
        except (ValueError, IndexError, RuntimeError, OSError, MemoryError) as failure:
            error, damage = failure, reason_of(failure)
    message = f"The COLMAP model in {folder} is incomplete or damaged: {damage}."
    raise UserError(message, remedy) from error


def _registered(folder: Path) -> int:
    """How many images a model has; none if it cannot be read."""
    try:
        return len(_reconstruction(folder)[0].images)
    except UserError:
        return 0


def _check_named_once(images: Sequence[RegisteredImage], folder: Path) -> None:
    """A file has one pose; of two, one would be taken without a word."""
    count = Counter(image.name for image in images)
    twice = next((name for name in sorted(count) if count[name] > 1), None)
    if twice is not None:
        raise UserError(
            f"The COLMAP model in {folder} has {count[twice]} images that are called {twice}.",
            "Remove all but one of them, or make the model again (colmap mapper).",
        )


def _name(image: pycolmap.Image, written: str | None, folder: Path) -> PurePosixPath:
    """The name of a registered image, also of one that was registered on Windows."""
    try:
        name = image.name if written is None else written
        name.encode()
        return PurePosixPath(name.replace("\\", "/"))
    except UnicodeError as error:  # the bytes of whatever encoding COLMAP was run in
        raw = error.object if isinstance(error, UnicodeDecodeError) else name.encode(errors="surrogateescape")
        raise UserError(
            f"The COLMAP model in {folder} calls an image {raw!r}, which is not UTF-8.",
            "Give the images names without accents and umlauts, in the folders and before colmap is run.",
        ) from error


def _viewmat(image: pycolmap.Image, name: PurePosixPath, folder: Path) -> NDArray[np.float64]:
    pose = image.cam_from_world()
    if not np.linalg.norm(pose.rotation.quat) > 0.5:  # pycolmap scales to 1 what can be scaled
        raise UserError(
            f"The COLMAP model in {folder} has no rotation for {str(name)!r}: its quaternion is zero or not finite.",
            "Register the images again (colmap mapper).",
        )
    viewmat = np.eye(4)
    viewmat[:3] = pose.matrix()
    return viewmat


_NEEDED = ("cameras", "images", "points3D")
_RIG = ("rigs", "frames")


def reason_of(error: Exception) -> str:
    """Why pycolmap could not read a model, without the place in its own source."""
    return " ".join(str(error).rpartition("] ")[2].split()).rstrip(".") or type(error).__name__


def _special(folder: Path) -> str | None:
    """A name of the model's files under which something else lies, such as a pipe, which is read for ever."""
    files = (f"{name}.{kind}" for name in (*_NEEDED, *_RIG) for kind in ("bin", "txt"))
    return next((f"{file} is no file" for file in files if (folder / file).exists() != (folder / file).is_file()), None)


def _missing(folder: Path) -> str | None:
    kinds = {kind: [name for name in _NEEDED if not (folder / f"{name}.{kind}").is_file()] for kind in ("bin", "txt")}
    kind = min(kinds, key=lambda kind: len(kinds[kind]))
    lacking = kinds[kind]
    if not lacking:  # a rig is in two files or, before COLMAP 3.12, in none
        rig = [name for name in _RIG if not (folder / f"{name}.{kind}").is_file()]
        lacking = rig if len(rig) == 1 else []
    if not lacking:
        return None
    there = ", ".join(sorted(path.name for path in folder.iterdir() if path.suffix == f".{kind}"))
    names = " and ".join(f"{name}.{kind}" for name in lacking)
    return f"{names} {'is' if len(lacking) == 1 else 'are'} missing beside {there}"
