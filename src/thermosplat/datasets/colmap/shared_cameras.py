"""Captures whose image files share the cameras of a COLMAP model's images: two layouts.

- RGBT-Scenes, as ThermalGaussian published it: rgb/{train,test}, thermal/{train,test} and a model. Both spectra of a
  frame have one stem, one pose and one camera. Without train/ and test/ the files lie in rgb/ and thermal/ themselves.
  Radiometric values may lie in thermal_raw/, divided or flat.
- A plain COLMAP project: images/, a model, and a folder per further spectrum with the stems of the photographs.
  thermal/ may hold pseudo-colour, grey, or radiometric files (16-bit PNG, float TIFF). Images that are not in the model
  share the photograph's camera; that has to show in equal sizes, or be said (``--thermal.aligned``).
"""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from thermosplat.datasets.colmap.model import ColmapModel, RegisteredImage
from thermosplat.datasets.frame_files import FrameFiles, Listing, Shot
from thermosplat.datasets.images.image_folders import spectrum_folder, values_folder
from thermosplat.datasets.images.image_names import (
    NamedImages,
    exposures,
    files_in,
    folders_of,
    frame_names,
    stated_split,
)
from thermosplat.datasets.images.masks import masks_by_spectrum
from thermosplat.spectra import SpectrumConfig


def named_images(images: Sequence[RegisteredImage], folders: Collection[str]) -> NamedImages[RegisteredImage]:
    """Registered images, to be found by the names of files, or by bare file stem where that is unambiguous.

    RGBT-Scenes needs the second: its model may name images of a folder that no longer exists.
    """
    named = [(image.name, image) for image in images]
    return NamedImages("the COLMAP model", named, same_files=True, by_stem=True, folders=folders)


def list_shared_cameras(
    root: Path, folder: Path, model: ColmapModel, spectra: Mapping[str, SpectrumConfig], *, published: bool
) -> Listing:
    """Files, cameras and points of a capture in one of the two layouts.

    Args:
        folder: Images of the first spectrum, which are in the model.
        published: It is RGBT-Scenes' layout, whose spectra are registered to each other.
    """
    frames, notes = _frames_with_borrowed_cameras(root, folder, model.images, spectra)
    layout = "rgbt-scenes" if published else "colmap"
    return Listing(layout, tuple(frames), model.points, model.point_colors, registered=published, notes=tuple(notes))


def _frames_with_borrowed_cameras(
    root: Path, folder: Path, images: Sequence[RegisteredImage], spectra: Mapping[str, SpectrumConfig]
) -> tuple[list[FrameFiles], list[str]]:
    """Frames whose images share the pose and camera of one registered image; notes on images without a pose."""
    files, values = files_of_spectra(root, folder, spectra)
    masks = masks_by_spectrum(root, spectra)
    registered = named_images(images, folders_of(spectra))
    found, without_pose = [], []
    for exposure in exposures(files):
        name = registered.find(exposure.name, files[exposure.leading])
        if name is None:
            without_pose.append(files[exposure.leading][exposure.name])
        else:
            found.append((exposure, registered[name]))
    frames = []
    where = next((named.where for named in files.values() if len(named)), folder.name)
    called = frame_names([exposure.name for exposure, _ in found], where, folders_of(spectra))
    for (exposure, image), frame in zip(found, called, strict=True):
        shots = {}
        for spectrum, name in exposure.names.items():
            raw, mask = (named[spectrum].get(name, files[spectrum]) for named in (values, masks))
            shots[spectrum] = Shot(files[spectrum][name], image.lens, image.viewmat, raw, mask)
        stated = [stated_split(name) for name in exposure.names.values()]
        frames.append(FrameFiles(frame, shots, next(filter(None, stated), None)))
    return frames, registration_notes(without_pose, len(registered) - len({image.name for _, image in found}))


def files_of_spectra(
    root: Path, folder: Path, spectra: Mapping[str, SpectrumConfig]
) -> tuple[dict[str, NamedImages[Path]], dict[str, NamedImages[Path]]]:
    """Displayable images, and values of more bits beside them, by spectrum; the values where there is nothing else."""
    files, values, folders = {}, {}, folders_of(spectra)
    for place, (name, spectrum) in enumerate(spectra.items()):
        own = folder if place == 0 else spectrum_folder(root, name, spectrum)
        files[name] = files_in(own, spectrum.source, folders=folders)
        values[name] = files_in(values_folder(root, name, spectrum), folders=folders)
        if place > 0 and not files[name]:
            files[name] = values[name]
    return files, values


def registration_notes(without_pose: Sequence[Path], without_file: int) -> list[str]:
    """Say what was left out because file and model do not meet."""
    notes = []
    if without_pose:
        names = f"first: {without_pose[0].name}"
        notes.append(f"{len(without_pose)} images are not in the COLMAP model and were left out ({names}).")
    if without_file:
        notes.append(f"{without_file} images of the COLMAP model have no file and were left out.")
    return notes
