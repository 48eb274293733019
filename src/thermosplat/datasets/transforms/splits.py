"""Which frames of a transforms file are held out: its lists of file names, else words of the names."""

import os
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

from thermosplat.config.values import shortened, shown
from thermosplat.datasets.frame_files import FrameFiles, Split
from thermosplat.datasets.images.image_files import IMAGE_SUFFIXES
from thermosplat.errors import UserError

_LISTS: dict[str, Split] = {"train_filenames": "train", "val_filenames": "test", "test_filenames": "test"}
"""nerfstudio's lists. Training looks at no image but its own, so validation images are held out as test images are."""
_EVAL_WORDS = frozenset({"eval", "test", "val"})
_WITHOUT_LISTS = "remove the lists: then the frames' names or --test-every divide them"

Splits = dict[PurePosixPath, Split]


def stated_splits(
    content: dict[str, Any], path: Path, names: Sequence[PurePosixPath]
) -> tuple[Splits | None, list[str]]:
    """The split of each frame that a list names, and notes.

    Returns:
        Splits by name, None where there are no lists: with lists, frames in none of them are not to be used.

    Raises:
        UserError: A list names an image of no frame, or is no list of names.
    """
    by_place, by_stem = defaultdict(set), defaultdict(set)
    for name in names:
        by_place[_place(path.parent, name)].add(name)
        by_stem[_place(path.parent, name).name].add(name)
    splits: Splits = {}
    both = set()
    for key, split in _LISTS.items():
        unknown = []
        for listed in _strings(content, key, path):
            place = _place(path.parent, PurePosixPath(listed.replace("\\", "/")))
            found = by_place.get(place) or by_stem.get(place.name, set())
            if len(found) != 1:
                unknown.append(listed)
            both |= {name for name in found if splits.get(name, split) != split}
            splits |= dict.fromkeys(found, split)
        if unknown:
            raise UserError(
                f"{key} of {path} names {len(unknown)} images that fit none of its frames, or several "
                f"(first: {shortened(unknown[0])}).",
                f"Write them as the frames' file_path does, or {_WITHOUT_LISTS}.",
            )
    notes = []
    if both and "train" not in splits.values():
        raise UserError(
            f"All {len(both)} images of train_filenames of {path} are in a list of held-out images, too.",
            f"Take those to train on out of the other list, or {_WITHOUT_LISTS}.",
        )
    if both:
        notes.append(
            f"{len(both)} of {len(names)} frames of {path.name} are in train_filenames and in a list of held-out "
            f"images (first: {min(both)}); they are held out."
        )
    unlisted = [name for name in names if name not in splits]
    if splits and unlisted:
        notes.append(
            f"{len(unlisted)} of {len(names)} frames of {path.name} are in none of its lists of file names and were "
            f"left out (first: {unlisted[0]})."
        )
    return splits or None, notes


def check_stated(frames: Sequence[FrameFiles], splits: Splits, path: Path) -> None:
    """Refuse lists that leave nothing to train on, or nothing to evaluate.

    Raises:
        UserError: There are no training or no held-out frames.
    """
    for split, kind in (("train", "training"), ("test", "held-out")):
        if any(frame.split == split for frame in frames):
            continue
        lists = ", ".join(key for key, stated in _LISTS.items() if stated == split)
        count = sum(stated == split for stated in splits.values())
        what = f"none of the {count} {kind} images that it lists exists" if count else f"it lists no {kind} images"
        raise UserError(
            f"{path} divides its frames by lists, and {what} ({lists}).",
            f"Put names of images that exist into {lists.split(', ')[-1]}, or {_WITHOUT_LISTS}.",
        )


def with_splits_from_names(frames: Sequence[FrameFiles], names: Sequence[PurePosixPath]) -> list[FrameFiles]:
    """Splits by words of the names and by folders, if they tell both kinds apart."""
    words = [
        {*_called(frame, name).lower().replace("-", "_").split("_"), *_folders(name)}
        for frame, name in zip(frames, names, strict=True)
    ]
    held_out = [bool(word & _EVAL_WORDS) for word in words]
    trained = ["train" in word for word in words]
    if not (any(held_out) and any(trained)):
        return list(frames)
    return [replace(frame, split="test" if test else "train") for frame, test in zip(frames, held_out, strict=True)]


def _called(frame: FrameFiles, name: PurePosixPath) -> str:
    """A frame's name, which may have its folders in it; without those around the capture."""
    return name.stem if name.is_absolute() else frame.name


def _folders(name: PurePosixPath) -> list[str]:
    """The folders inside the capture; those around it say nothing of its frames."""
    return [] if name.is_absolute() else [part.lower() for part in name.parts[:-1]]


def _strings(content: dict[str, Any], key: str, path: Path) -> list[str]:
    stated = content.get(key) or []
    if not isinstance(stated, list) or not all(isinstance(name, str) for name in stated):
        raise UserError(
            f"{key} of {path} must be a list of file names, found {shown(stated)}.",
            f"Write them as the frames' file_path does, or {_WITHOUT_LISTS}.",
        )
    return stated


def _place(root: Path, name: PurePosixPath) -> PurePosixPath:
    """Where a name points, without its ending: names may lack that, begin with ./ or be absolute."""
    place = PurePosixPath(os.path.abspath(root / name))
    return place.with_suffix("") if place.suffix.lower() in IMAGE_SUFFIXES else place
