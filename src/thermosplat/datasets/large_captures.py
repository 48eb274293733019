"""Captures whose images take more memory than they may: headers and a sample are read, all else when it is needed."""

import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import overload

from thermosplat.datasets.cameras import Camera
from thermosplat.datasets.frame_files import FrameFiles, Listing, Shot
from thermosplat.datasets.host_memory import host_memory
from thermosplat.datasets.image_size import TrainedSize
from thermosplat.datasets.images.image_bytes import FileStamp, ImageHeader, read_header
from thermosplat.datasets.images.image_files import read_image
from thermosplat.datasets.images.pixel_meaning import PixelMeaning, SpectrumFile
from thermosplat.datasets.images.spectrum_files import read_shot, read_spectrum
from thermosplat.datasets.images.spectrum_images import SpectrumReading
from thermosplat.datasets.lens import Lens
from thermosplat.datasets.pixel_cache import PixelCache
from thermosplat.datasets.stored_pixels import StoredPixels
from thermosplat.errors import UserError
from thermosplat.evenly_chosen import evenly_chosen
from thermosplat.spectra import Source, SpectrumConfig, label

GIGABYTE = 10**9
SHARE_OF_HOST = 0.5
"""Of the host's memory that images may take where nobody says otherwise."""
SAMPLED = 16
"""Frames of each spectrum, spread over all, that say what its images are. Open choice."""
RANGED_BYTES = 2 * GIGABYTE
"""Radiometric files of a spectrum, decoded, whose extremes are its range; of more, files spread over all. Half a minute
on two cores. Open choice."""
_VALUES_BYTES = 8
"""Of a pixel of values as a view keeps it: image and values, float32."""


def allowed_memory(image_memory: float | None) -> float:
    """What the images of this process may take in the host's memory [bytes].

    Args:
        image_memory: ``TrainConfig.image_memory`` [GB].
    """
    of_host = SHARE_OF_HOST * host_memory() if image_memory is None else image_memory * GIGABYTE
    return of_host / processes_here()


def processes_here() -> int:
    """Processes that train one scene on this host, each on a device: torchrun tells them how many there are."""
    return max(1, int(os.environ.get("LOCAL_WORLD_SIZE", "1")))


class Headers:
    """What the files of a capture say of their images."""

    def __init__(self, frames: Sequence[FrameFiles]) -> None:
        paths = {path for frame in frames for shot in frame.shots.values() for path in shot.files}
        with ThreadPoolExecutor() as pool:
            self._found = dict(zip(paths, pool.map(_header_if_any, paths)))

    def sizes(self, frames: Sequence[FrameFiles]) -> list[tuple[Path, int, int]]:
        """File, width and height [px] of each exposure that can be read."""
        shots = [shot for frame in frames for shot in frame.shots.values()]
        found = [(shot.path, self._found[shot.path][0]) for shot in shots if shot.path in self._found]
        return [(path, header.width, header.height) for path, header in found if header is not None]

    def taken_at_once(self, frames: Sequence[FrameFiles], size: TrainedSize) -> int:
        """Memory that the images of all frames take while they are read, and as views [bytes]; of files that cannot be
        read nothing.
        """
        total = 0
        for shot in (shot for frame in frames for shot in frame.shots.values()):
            found = [header for path in shot.images if (header := self._found[path][0]) is not None]
            total += sum(header.decoded_bytes for header in found)
            radiometric = any(header.is_radiometric or header.channels == 1 for header in found)
            shown = [(header.width, header.height) for header in found]
            pixels = max((width * height / size.divisor(width, height) ** 2 for width, height in shown), default=0.0)
            masked = shot.mask is not None or any(header.has_alpha for header in found)
            total += int(pixels * ((_VALUES_BYTES if radiometric else 3) + masked))
        return total

    def of(self, path: Path) -> ImageHeader:
        """The header of a file.

        Raises:
            UserError: It is damaged, or no image.
        """
        header = self._found[path][0]
        if header is None:
            read_image(path)  # says what is wrong with it
            raise UserError(f"{path} is damaged or not an image.", "Restore it, or remove it from the folder.")
        return header

    def stamp(self, path: Path) -> FileStamp:
        """The stamp of a file that ``of`` has found."""
        stamp = self._found[path][1]
        if stamp is None:
            raise ValueError(f"{path} has not been read.")
        return stamp

    def values_of(self, shot: Shot) -> Path | None:
        """The radiometric file of an exposure."""
        if shot.raw is not None and shot.raw != shot.path:
            return shot.raw
        return shot.path if self.of(shot.path).is_radiometric else None

    def display_of(self, shot: Shot) -> Path | None:
        """The displayable file of an exposure."""
        return None if self.of(shot.path).is_radiometric else shot.path


def _header_if_any(path: Path) -> tuple[ImageHeader | None, FileStamp | None]:
    try:
        return read_header(path)
    except UserError:
        return None, None


@dataclass(frozen=True, eq=False)
class UnreadPixels:
    """An exposure whose pixels have not been read: what ``StoredPixels`` holds, without the camera."""

    shot: Shot
    header: ImageHeader
    stamps: tuple[FileStamp, ...]
    source: Source
    meaning: PixelMeaning
    cache: PixelCache

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the file's image [px]."""
        return self.header.width, self.header.height

    def seen_by(self, camera: Camera, lens: Lens | None) -> StoredPixels:
        """Where a view of a camera finds them, with the distortion of a lens taken out."""
        return StoredPixels(self.shot, self.header, self.stamps, self.source, self.meaning, camera, lens, self.cache)


def sampled_frames(frames: Sequence[FrameFiles], spectra: Mapping[str, SpectrumConfig], headers: Headers) -> list[int]:
    """Indices of the frames that say what the images are: spread over each spectrum, and those that are unlike others.

    Args:
        headers: Of their files.
    """
    chosen: set[int] = set()
    for name, spectrum in spectra.items():
        having = [index for index, frame in enumerate(frames) if name in frame.shots]
        chosen.update(evenly_chosen(having, SAMPLED))
        if spectrum.source == "photograph":
            continue
        for found in (headers.display_of, headers.values_of):  # the first that has one, and the first that lacks it
            there = [found(frames[index].shots[name]) is not None for index in having]
            chosen.update(having[there.index(state)] for state in (True, False) if state in there)
    return sorted(chosen)


class _Exposures(Sequence[SpectrumFile]):
    """Exposures that are read while they are gone through, some at a time."""

    def __init__(self, shots: Sequence[Shot], source: Source) -> None:
        self._shots, self._source = shots, source

    def __len__(self) -> int:
        return len(self._shots)

    @overload
    def __getitem__(self, index: int) -> SpectrumFile: ...
    @overload
    def __getitem__(self, index: slice) -> "_Exposures": ...
    def __getitem__(self, index: int | slice) -> "SpectrumFile | _Exposures":
        if isinstance(index, slice):
            return _Exposures(self._shots[index], self._source)
        return read_shot(self._shots[index], self._source)

    def __iter__(self) -> Iterator[SpectrumFile]:
        at_once = os.cpu_count() or 1
        with ThreadPoolExecutor(at_once) as pool:
            for start in range(0, len(self._shots), at_once):
                yield from pool.map(lambda shot: read_shot(shot, self._source), self._shots[start : start + at_once])


def read_sample(
    root: Path,
    name: str,
    spectrum: SpectrumConfig,
    frames: Sequence[FrameFiles],
    sample: Sequence[int],
    headers: Headers,
    listing: Listing,
) -> tuple[SpectrumReading | None, list[str]]:
    """What the images of one spectrum are, by some of them.

    Returns:
        The reading of the sample, None if no frame has the spectrum; and what to tell of a range that is not that of
        all images.

    Raises:
        UserError: As ``read_spectrum``.
    """
    shots = [shot for frame in frames if (shot := frame.shots.get(name)) is not None]
    having = [] if spectrum.source == "photograph" else [shot for shot in shots if headers.values_of(shot) is not None]
    taken = sum(headers.of(path).decoded_bytes for shot in having if (path := headers.values_of(shot)) is not None)
    every = max(1, -(-taken // RANGED_BYTES))
    ranging = _Exposures(having[::every], spectrum.source) if having else None
    reading = read_spectrum(root, name, spectrum, [frames[index] for index in sample], listing, ranging)
    if reading is None or not reading.meaning.of_values or spectrum.range is not None or every == 1:
        return reading, []
    low, high = reading.meaning.ends
    return reading, [
        f"The range of the {label(name)} values is that of {len(having[::every]):,} of {len(having):,} images: "
        f"{low:,.6g} to {high:,.6g}. Values beyond are clipped in training; --{name}.range MIN MAX says otherwise."
    ]


def unread_pixels(
    shot: Shot, spectrum: SpectrumConfig, meaning: PixelMeaning, headers: Headers, cache: PixelCache
) -> UnreadPixels | None:
    """An exposure as its headers describe it; None where it lacks the file that images are made of.

    Raises:
        UserError: A file is damaged, or no image.
    """
    path: Path | None = shot.path
    if meaning.kind != "photograph":
        path = headers.values_of(shot) if meaning.of_values else headers.display_of(shot)
    if path is None:
        return None
    stamps = tuple(headers.stamp(file) for file in shot.files if headers.of(file))
    return UnreadPixels(shot, headers.of(path), stamps, spectrum.source, meaning, cache)
