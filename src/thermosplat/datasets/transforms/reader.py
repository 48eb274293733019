"""ThermoScenes and nerfstudio: transforms_thermal.json or transforms.json with a camera-to-world pose per frame.

The thermal image of a frame is its `thermal_file_path`, else the file of the same name in thermal/, and shares the
photograph's camera; images of further spectra likewise. Names like frame_train_00001 and frame_eval_00001 state the
split, as do train_filenames and test_filenames. temperature_bounds.json gives the temperatures of black and white.

In the compilation of SEAR (arXiv 2603.18774) a frame holds an object per spectrum, "rgb" and "thermal", each with its
file, its intrinsics and its world-to-camera pose with OpenCV axes.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from thermosplat.datasets.frame_files import FrameFiles, Listing, Shot
from thermosplat.datasets.images.image_names import folders_of, frame_names
from thermosplat.datasets.transforms.cameras import frame_lens, frame_viewmat
from thermosplat.datasets.transforms.images import TransformsImages, file_keys, image_name, mask_keys
from thermosplat.datasets.transforms.points import transforms_points
from thermosplat.datasets.transforms.splits import check_stated, stated_splits, with_splits_from_names
from thermosplat.errors import UserError
from thermosplat.spectra import SpectrumConfig
from thermosplat.thermal.temperature_units import celsius_range, read_json

_NAMES = ("transforms_thermal.json", "transforms.json")


def find_transforms(root: Path) -> Path | None:
    """The transforms file of a capture, or None."""
    return next((root / name for name in _NAMES if (root / name).is_file()), None)


def list_transforms(
    root: Path, path: Path, model_folder: Path | None, spectra: Mapping[str, SpectrumConfig]
) -> Listing:
    """Files, cameras and points of a capture in this layout.

    Args:
        model_folder: A COLMAP model beside it, for its points; or None.

    Raises:
        UserError: The file lacks intrinsics, poses or frames.
    """
    content = read_json(path)
    keys = file_keys(spectra)
    entries = _entries(content, path, keys, list(mask_keys(spectra).values()))
    names = [image_name(root, entry, keys) for entry in entries]
    splits, notes = stated_splits(content, path, names)
    _check_listed_once(names, path)
    called = frame_names(names, path.name, folders_of(spectra))
    images = TransformsImages(root, path, names, spectra)
    frames, found = [], []
    for number, (name, entry) in enumerate(zip(names, entries, strict=True)):
        if splits is not None and name not in splits:
            continue
        files = images.find(name, entry)
        if files is None:
            continue
        found.append(name)
        shots = {}
        for spectrum, file in files.items():
            own = _own_view(entry, spectrum)
            viewmat = frame_viewmat(own or entry, path, number, to_camera=own is not None)
            lens = frame_lens(own or entry, content, path, number, (file if own else next(iter(files.values()))).path)
            shots[spectrum] = Shot(file.path, lens, viewmat, file.values, file.mask)
        frames.append(FrameFiles(called[number], shots, None if splits is None else splits[name]))
    if not frames:
        first = next(iter(images.not_found.values()), names[0])
        raise UserError(
            f"None of the {len(entries)} images that {path} lists exists (first: {first}).",
            "Paths are absolute, or relative to the folder of that file. Is it the right folder?",
        )
    if splits is None:
        frames = with_splits_from_names(frames, found)
    else:
        check_stated(frames, splits, path)
    points, colors, point_notes = transforms_points(root, path.name, content, frames, model_folder)
    return Listing(
        "transforms",
        tuple(frames),
        points,
        colors,
        celsius_range=_temperature_bounds(root),
        not_found=images.not_found,
        notes=(*notes, *point_notes, *images.notes()),
    )


def _own_view(entry: dict[str, Any], spectrum: str) -> dict[str, Any] | None:
    """What a frame says of one spectrum alone, or None."""
    own = entry.get(spectrum)
    return own if isinstance(own, dict) and "transform_matrix" in own else None


def _entries(
    content: dict[str, Any], path: Path, named: Mapping[str, str], masks: Sequence[str]
) -> list[dict[str, Any]]:
    """What the file says of each frame: an object that names its files under some of the keys, and perhaps masks."""
    entries, keys = content.get("frames"), list(named.values())
    hint = "Expected nerfstudio's transforms: under 'frames' a list of objects with file_path and transform_matrix."
    if not isinstance(entries, list) or not entries:
        raise UserError(f"{path} lists no frames.", hint)
    for number, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise UserError(f"Frame {number} of {path} must be an object, found {json.dumps(entry)[:60]}.", hint)
        views = {key: _own_view(entry, spectrum) for spectrum, key in named.items()}
        entry |= {key: view.get("file_path") for key, view in views.items() if view is not None}
        for key in (*keys, *masks):
            if not isinstance(entry.get(key) or "", str):
                found = json.dumps(entry[key])[:60]
                raise UserError(f"{key} of frame {number} of {path} must be a file name, found {found}.", hint)
        if not any(entry.get(key) for key in keys):
            raise UserError(f"Frame {number} of {path} has no file_path.", hint)
    return [_with_slashes(entry, [*keys, *masks]) for entry in entries]


def _with_slashes(entry: dict[str, Any], keys: Sequence[str]) -> dict[str, Any]:
    """What is said of a frame, with its files named as here where they were named on Windows."""
    named = {key: entry[key] for key in keys if entry.get(key)}
    return entry | {key: name.replace("\\", "/") for key, name in named.items()}


def _check_listed_once(names: Sequence[PurePosixPath], path: Path) -> None:
    """An image of two frames could be trained on and held out."""
    seen = set()
    for name in names:
        if name in seen:
            raise UserError(f"{path} lists {name} in two frames.", "Remove one of them.")
        seen.add(name)


def _temperature_bounds(root: Path) -> tuple[float, float] | None:
    path = root / "temperature_bounds.json"
    if not path.is_file():
        return None
    return celsius_range(read_json(path), path, "absolute_min_temperature", "absolute_max_temperature")
