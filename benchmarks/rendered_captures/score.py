"""How true are images in degrees, of any method, beside those of a rendered capture?

A folder holds one file per held-out view, with the view's stem: TIFF, PNG or npy, 16-bit centikelvin or floats in
deg C. Views that it lacks are an error: a mean over the views that went well is no score.
"""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from rendered_captures.scene_builder import LABELS
from thermosplat.errors import UserError

_ENDINGS = (".tiff", ".tif", ".png", ".npy")


class View(NamedTuple):
    """What a held-out view should show."""

    celsius: NDArray[Any]
    """[H, W], without the level that drifted."""
    label: NDArray[Any] | None
    """Numbers of ``LABELS``, [H, W]."""


def score(images: Path, capture: Path) -> str:
    """A table in Markdown: mean absolute error, bias and RMSE [K], of all pixels and by label.

    Args:
        images: A run of thermosplat, or a folder of images.
        capture: The folder that was rendered.

    Raises:
        UserError: Something is missing, or sizes differ.
    """
    views = true_views(capture)
    is_run = (images / "config.yaml").is_file() and (images / "ckpts").is_dir()
    found = _rendered(images, capture) if is_run else _of_folder(images)
    missing = sorted(views.keys() - found.keys())
    if missing:
        raise UserError(
            f"{images} has no image of {len(missing)} of the {len(views)} held-out views, the first is {missing[0]}.",
            f"Write {missing[0]}.tiff: 16-bit centikelvin, or floats in deg C.",
        )
    errors, labels = [], []
    for stem, view in views.items():
        image = found[stem]()
        if image.shape != view.celsius.shape:
            sizes = " and ".join(f"{side.shape[1]}x{side.shape[0]}" for side in (image, view.celsius))
            raise UserError(
                f"{stem}: the image and the capture's have {sizes} pixels.", "Render at the capture's size."
            )
        errors.append((image - view.celsius).ravel())
        labels.append(np.zeros(image.size, int) if view.label is None else view.label.ravel())
    error, label = np.concatenate(errors), np.concatenate(labels)
    if not np.isfinite(error).all():
        raise UserError(f"{images} has pixels that are no numbers.", "Every pixel of a held-out view counts.")
    lines = ["| pixels of | number | MAE [K] | bias [K] | RMSE [K] |", "|---|---|---|---|---|"]
    for name, chosen in {"all": label >= 0, **{name: label == number for name, number in LABELS.items()}}.items():
        if chosen.any():
            part = error[chosen]
            measures = f"{np.abs(part).mean():.3f} | {part.mean():+.3f} | {np.sqrt(np.square(part).mean()):.3f}"
            lines.append(f"| {name.replace('_', ' ')} | {part.size:,} | {measures} |")
    return "\n".join(lines)


def true_views(capture: Path) -> dict[str, View]:
    """Held-out views of a paired capture; all thermal images of a rig or a flight."""
    if (capture / "ground_truth").is_dir():
        levels = _levels(capture / "level_drift_K.json")
        return {
            path.stem: View(
                celsius_of(_only(capture / "thermal_raw", path.stem)) - levels.get(f"{path.stem}.tiff", 0.0),
                np.load(path, allow_pickle=False)["label"],
            )
            for path in sorted((capture / "ground_truth").glob("*.npz"))
        }
    if not (capture / "truth.json").is_file():
        raise UserError(f"{capture} is no rendered capture: it has neither ground_truth/ nor truth.json.")
    levels = json.loads((capture / "truth.json").read_text()).get("level_drift_K", {})
    files = sorted((capture / "thermal").glob("*.tiff"))
    return {path.stem: View(celsius_of(path) - levels.get(path.name, 0.0), None) for path in files}


def celsius_of(path: Path) -> NDArray[np.float64]:
    """An image's temperatures [deg C], [H, W].

    Raises:
        UserError: The file is no image with one value per pixel.
    """
    try:
        if path.suffix == ".npy":
            values: Any = np.load(path, allow_pickle=False)
        else:
            values = tifffile.imread(path) if path.suffix in (".tif", ".tiff") else cv2.imread(str(path), -1)
        values = np.asarray(values)
    except (OSError, ValueError, tifffile.TiffFileError) as error:
        raise UserError(f"{path} cannot be read: {error}") from error
    if values.ndim != 2 or not (values.dtype == np.uint16 or values.dtype.kind == "f"):
        raise UserError(f"{path} has no single value per pixel of 16 bits or floats.", "Write centikelvin or deg C.")
    return values / 100.0 - 273.15 if values.dtype == np.uint16 else values.astype(np.float64)


def _levels(path: Path) -> dict[str, float]:
    return json.loads(path.read_text()) if path.is_file() else {}


def _only(folder: Path, stem: str) -> Path:
    for path in folder.rglob(f"{stem}.tiff"):
        return path
    raise UserError(f"{folder} has no {stem}.tiff.")


def _of_folder(folder: Path) -> Mapping[str, Callable[[], NDArray[np.float64]]]:
    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in _ENDINGS)
    return {path.stem: lambda path=path: celsius_of(path) for path in files}


def _rendered(run: Path, capture: Path) -> Mapping[str, Callable[[], NDArray[np.float64]]]:
    """The held-out views as a run renders them."""
    from bench_recalculated import apparent_views

    _, images = apparent_views(str(run), str(capture))
    return {name.rsplit("/", 1)[-1]: lambda image=image: image.astype(np.float64) for name, image in images.items()}
