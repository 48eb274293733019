"""Names of images: which files and registered images are of one exposure, and what its frame is called.

A name is a path relative to the folder of the images. Names are compared by *keys*: what they have in common with the
name of the same exposure in another folder.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, Generic, NamedTuple, TypeVar

from thermosplat.datasets.colmap_model import THERMAL_FOLDERS
from thermosplat.datasets.frame_files import Split
from thermosplat.datasets.image_files import list_images
from thermosplat.errors import UserError

T = TypeVar("T")
Key = Callable[[PurePosixPath], str]

SPLIT_FOLDERS: tuple[Split, ...] = ("train", "test")
RGB_FOLDERS = frozenset({"rgb", "images", "visible", "vis", "color"})
"""Folders that say nothing but "these are the RGB images"; left out where names are compared."""


def stem_key(name: PurePosixPath) -> str:
    """What identifies an image across folders: its path without modality folders, train/test and ending."""
    return _key(name, THERMAL_FOLDERS | RGB_FOLDERS | set(SPLIT_FOLDERS))


def split_key(name: PurePosixPath) -> str:
    """As ``stem_key``, with train/test: for captures that have a stem in both."""
    return _key(name, THERMAL_FOLDERS | RGB_FOLDERS)


def file_key(name: PurePosixPath) -> str:
    """As ``split_key``, with the ending: for captures that have a stem with several."""
    return split_key(name) + name.suffix


def _key(name: PurePosixPath, skipped: Iterable[str]) -> str:
    folders = [part for part in name.parts[:-1] if part.lower() not in skipped]
    return "/".join([*folders, name.stem])


def stated_split(name: PurePosixPath) -> Split | None:
    """The split that the first folder of a name says, in any case."""
    return next((split for split in SPLIT_FOLDERS if name.parts[0].lower() == split and len(name.parts) > 1), None)


def frame_names(names: Sequence[PurePosixPath], where: str) -> list[str]:
    """What the frames of these images are called: without folders, since output files are named after them.

    Where some would be called the same, all have their train/test in it, or if that is not enough all of their path.

    Args:
        names: One image's name for each frame.
        where: What holds them, for the message.

    Raises:
        UserError: Two would be called the same with that.
    """
    for key in (stem_key, split_key, lambda name: str(name.with_suffix("")), str):
        called = {name: key(name).replace("/", "_") for name in names}
        if len(set(called.values())) == len(called):
            break
    else:
        by_frame: dict[str, PurePosixPath] = {}
        for name, frame in called.items():
            other = by_frame.setdefault(frame, name)
            if other != name:
                raise UserError(f"{other} and {name} of {where} would both be called {frame}.", "Rename one of them.")
    return [called[name] for name in names]


class NamedImages(Generic[T]):
    """Images that can be found by the name of the same exposure's image in another folder.

    Keys are compared that say as little as possible: without train/test and ending, as long as that tells which images
    belong together.

    Args:
        where: What holds them, for messages.
        images: Names, each with what is known of the image.
        same_files: These may be the very files that they are looked up for, so that endings tell them apart.
        by_stem: Where no key fits, a bare stem does, if it is the only one.
    """

    def __init__(
        self, where: str, images: Iterable[tuple[PurePosixPath, T]], *, same_files: bool = False, by_stem: bool = False
    ) -> None:
        self.where = where
        self._images = dict(images)
        self._keys: tuple[Key, ...] = (split_key, file_key, str) if same_files else (split_key,)
        self._like: dict[str, list[PurePosixPath]] = defaultdict(list)
        self._of_stem: dict[str, list[PurePosixPath]] = defaultdict(list)
        for name in self._images:
            self._like[stem_key(name)].append(name)
            self._of_stem[name.stem].append(name)
        self._by_stem = by_stem

    def __iter__(self) -> Iterator[PurePosixPath]:
        return iter(self._images)

    def __len__(self) -> int:
        return len(self._images)

    def __getitem__(self, name: PurePosixPath) -> T:
        return self._images[name]

    def find(self, name: PurePosixPath, others: "NamedImages[Any]") -> PurePosixPath | None:
        """The name of the image that belongs to one of another folder.

        Args:
            name: That one's name.
            others: What it is in; of several images there with that key, each has its own here or none.

        Returns:
            The name, or None where there is no such image.

        Raises:
            UserError: There are several, here or there, and nothing tells which of them belong together.
        """
        candidates, rivals = self._like.get(stem_key(name), []), others._like.get(stem_key(name), [])
        if not candidates and self._by_stem:
            candidates, rivals = self._of_stem.get(name.stem, []), others._of_stem.get(name.stem, [])
            if len(candidates) > 1:
                return None
        if not candidates:
            return None
        if len(candidates) == 1 and len(rivals) <= 1:
            return candidates[0]
        for key in self._keys:
            here, there = [key(one) for one in candidates], [key(one) for one in rivals]
            if there.count(key(name)) > 1 or here.count(key(name)) > 1:
                continue
            if key(name) in here:
                return candidates[here.index(key(name))]
            if set(here) <= set(there):  # they belong to the others
                return None
        several, one = (rivals, candidates[0]) if len(rivals) > 1 else (candidates, name)
        having, lacking = (others, self) if len(rivals) > 1 else (self, others)
        raise UserError(
            f"{several[0]} and {several[1]} of {having.where} have one stem, and {one} of {lacking.where} may belong "
            "to either.",
            "Rename them, or divide all folders and the model into train/ and test/ alike; remove what is there twice.",
        )


class Exposure(NamedTuple):
    """Names of the images that were taken together."""

    name: PurePosixPath
    """The RGB image's, or of an exposure without one the thermal image's."""
    rgb: PurePosixPath | None
    thermal: PurePosixPath | None


def exposures(rgb: NamedImages[Any], thermal: NamedImages[Any]) -> list[Exposure]:
    """RGB images with the thermal images that belong to them, and thermal images that belong to none, by name.

    Args:
        rgb: RGB images.
        thermal: Thermal images.

    Raises:
        UserError: As ``NamedImages.find``.
    """
    found = [Exposure(name, name, thermal.find(name, rgb)) for name in rgb]
    paired = {exposure.thermal for exposure in found}
    found += [Exposure(name, None, name) for name in thermal if name not in paired]
    return sorted(found, key=lambda exposure: (split_key(exposure.name), str(exposure.name)))


def files_in(folder: Path, *, by_stem: bool = False) -> NamedImages[Path]:
    """The image files below a folder.

    Args:
        folder: May be absent.
        by_stem: As of ``NamedImages``.
    """
    paths = list_images(folder, recursive=True)
    named = [(PurePosixPath(path.relative_to(folder).as_posix()), path) for path in paths]
    return NamedImages(f"{folder.name}/", named, by_stem=by_stem)
