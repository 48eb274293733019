"""Names of images: which files and registered images are of one exposure, and what its frame is called.

A name is a path relative to the folder of the images. Names are compared by *keys*: what they have in common with the
name of the same exposure in another folder.
"""

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, Generic, NamedTuple, TypeVar

from thermosplat.datasets.frame_files import Split
from thermosplat.datasets.images.image_files import list_images
from thermosplat.datasets.images.stack_files import list_stacks
from thermosplat.errors import UserError
from thermosplat.spectra import DEFAULT_SPECTRA, STACKS, Source, SpectrumConfig, folder_names

T = TypeVar("T")
Key = Callable[[PurePosixPath], str]

SPLIT_FOLDERS: tuple[Split, ...] = ("train", "test")
USUAL_FOLDERS = frozenset(folder for spectrum in DEFAULT_SPECTRA.values() for folder in spectrum.folders)
"""Folders of the usual spectra: they say nothing but which one an image is of."""


def folders_of(spectra: Mapping[str, SpectrumConfig]) -> frozenset[str]:
    """Folders that are left out where names of these spectra's images are compared."""
    return USUAL_FOLDERS | {folder for name, spectrum in spectra.items() for folder in folder_names(name, spectrum)}


def stem_key(name: PurePosixPath, folders: Collection[str] = USUAL_FOLDERS) -> str:
    """What identifies an image across folders: its path without folders of spectra, train/test and ending."""
    return _key(name, {*folders, *SPLIT_FOLDERS})


def split_key(name: PurePosixPath, folders: Collection[str] = USUAL_FOLDERS) -> str:
    """As ``stem_key``, with train/test: for captures that have a stem in both."""
    return _key(name, folders)


def file_key(name: PurePosixPath, folders: Collection[str] = USUAL_FOLDERS) -> str:
    """As ``split_key``, with the ending: for captures that have a stem with several."""
    return split_key(name, folders) + name.suffix


def _key(name: PurePosixPath, skipped: Collection[str]) -> str:
    folders = [part for part in name.parts[:-1] if part.lower() not in skipped]
    return "/".join([*folders, name.stem])


def stated_split(name: PurePosixPath) -> Split | None:
    """The split that the first folder of a name says, in any case."""
    return next((split for split in SPLIT_FOLDERS if name.parts[0].lower() == split and len(name.parts) > 1), None)


def frame_names(names: Sequence[PurePosixPath], where: str, folders: Collection[str] = USUAL_FOLDERS) -> list[str]:
    """What the frames of these images are called: without folders, since output files are named after them.

    Where some would be called the same, all have their train/test in it, or if that is not enough all of their path.

    Args:
        where: What holds them, for the message.

    Raises:
        UserError: Two would be called the same with that.
    """
    keys: tuple[Key, ...] = (
        partial(stem_key, folders=folders),
        partial(split_key, folders=folders),
        lambda name: str(name.with_suffix("")),
        str,
    )
    for key in keys:
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
        folders: As ``folders_of`` has them; the same for images that are looked up by each other's names.
    """

    def __init__(
        self,
        where: str,
        images: Iterable[tuple[PurePosixPath, T]],
        *,
        same_files: bool = False,
        by_stem: bool = False,
        folders: Collection[str] = USUAL_FOLDERS,
    ) -> None:
        self.where = where
        self._images = dict(images)
        self._stem_key = partial(stem_key, folders=folders)
        in_split, with_ending = partial(split_key, folders=folders), partial(file_key, folders=folders)
        self._keys: tuple[Key, ...] = (in_split, with_ending, str) if same_files else (in_split,)
        self._like: dict[str, list[PurePosixPath]] = defaultdict(list)
        self._of_stem: dict[str, list[PurePosixPath]] = defaultdict(list)
        for name in self._images:
            self._like[self._stem_key(name)].append(name)
            self._of_stem[name.stem].append(name)
        self._by_stem = by_stem

    def __iter__(self) -> Iterator[PurePosixPath]:
        return iter(self._images)

    def __len__(self) -> int:
        return len(self._images)

    def __getitem__(self, name: PurePosixPath) -> T:
        return self._images[name]

    def get(self, name: PurePosixPath, others: "NamedImages[Any]") -> T | None:
        """What is known of the image that belongs to one of another folder; None where there is none.

        The arguments are those of ``find``.

        Raises:
            UserError: As ``find``.
        """
        found = self.find(name, others)
        return None if found is None else self[found]

    def find(self, name: PurePosixPath, others: "NamedImages[Any]") -> PurePosixPath | None:
        """The name of the image that belongs to one of another folder.

        Args:
            others: What it is in; of several images there with that key, each has its own here or none.

        Returns:
            The name, or None where there is no such image.

        Raises:
            UserError: There are several, here or there, and nothing tells which of them belong together.
        """
        key = self._stem_key(name)
        candidates, rivals = self._like.get(key, []), others._like.get(key, [])
        if not candidates and self._by_stem:
            candidates, rivals = self._of_stem.get(name.stem, []), others._of_stem.get(name.stem, [])
            if len(candidates) > 1:
                return None
        if not candidates:
            return None
        if len(candidates) == 1 and len(rivals) <= 1:
            return candidates[0]
        for key_of in self._keys:
            here, there = [key_of(one) for one in candidates], [key_of(one) for one in rivals]
            key = key_of(name)
            if there.count(key) > 1 or here.count(key) > 1:
                continue
            if key in here:
                return candidates[here.index(key)]
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

    names: dict[str, PurePosixPath]
    """By spectrum, at least one."""

    @property
    def leading(self) -> str:
        """The first spectrum that it has."""
        return next(iter(self.names))

    @property
    def name(self) -> PurePosixPath:
        """That spectrum's image."""
        return self.names[self.leading]


def exposures(images: Mapping[str, NamedImages[Any]]) -> list[Exposure]:
    """Images of all spectra that belong together, by name.

    Args:
        images: By spectrum, in order. Those of a later one join the exposures of the earlier ones, or stand alone.

    Raises:
        UserError: As ``NamedImages.find``.
    """
    found: list[Exposure] = []
    for spectrum, named in images.items():
        joined = set()
        for exposure in found:
            name = named.find(exposure.name, images[exposure.leading])
            if name is not None:
                exposure.names[spectrum] = name
                joined.add(name)
        found += [Exposure({spectrum: name}) for name in named if name not in joined]
    return sorted(found, key=lambda exposure: (split_key(exposure.name), str(exposure.name)))


def files_in(
    folder: Path, source: Source = "auto", *, by_stem: bool = False, folders: Collection[str] = USUAL_FOLDERS
) -> NamedImages[Path]:
    """The image files below a folder. The other arguments are those of ``NamedImages``.

    Args:
        folder: May be absent.
        source: What the spectrum's images are, which says what files they may be.
    """
    paths = list_stacks(folder) if source in STACKS else list_images(folder, recursive=True)
    named = [(PurePosixPath(path.relative_to(folder).as_posix()), path) for path in paths]
    return NamedImages(f"{folder.name}/", named, by_stem=by_stem, folders=folders)
