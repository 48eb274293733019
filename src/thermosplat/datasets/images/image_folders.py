"""The folders of a capture that hold its images, and what to say where they do not."""

from collections.abc import Collection, Mapping
from pathlib import Path

from thermosplat.datasets.images.image_files import IMAGE_SUFFIXES, list_images
from thermosplat.datasets.images.unread_formats import unread_note
from thermosplat.regular_files import files_below
from thermosplat.spectra import SpectrumConfig, folder_names, label


def image_folder(root: Path, name: str, others: Collection[str] = ()) -> Path:
    """A folder by its name in any case, or by another name that means the same.

    Returns:
        Of several folders one that has images, preferably the usual one; the usual one also where there is none.
    """
    names = {name, *others}
    found = [path for path in root.iterdir() if path.name.lower() in names and path.is_dir()] if root.is_dir() else []
    if len(found) > 1:
        found.sort(
            key=lambda path: (not list_images(path, recursive=True), path.name.lower() != name, path.name != name)
        )
    return found[0] if found else root / name


def spectrum_folder(root: Path, name: str, spectrum: SpectrumConfig) -> Path:
    """The capture's folder with the images of a spectrum."""
    usual, *others = folder_names(name, spectrum)
    return image_folder(root, usual, others)


def values_folder(root: Path, name: str, spectrum: SpectrumConfig) -> Path:
    """The capture's folder with a spectrum's values of more than 8 bits, beside that of displayable images."""
    return root / f"{folder_names(name, spectrum)[0]}_raw"


def describe_folder(folder: Path) -> str:
    """The folder's name and how many files lie below it, for messages."""
    return f"{folder.name}/ ({len(files_below(folder))} files)"


def looked_for(root: Path, name: str, spectra: Mapping[str, SpectrumConfig], example: Path | None) -> tuple[str, str]:
    """What was found where images of a spectrum are looked for, and what to do.

    Args:
        example: An image of another spectrum, as an example of a name.
    """
    usual, *others = folder_names(name, spectra[name])
    folder = spectrum_folder(root, name, spectra[name])
    found = _images_in(folder)
    if found is None:
        nor = f" (nor {', '.join(f'{other}/' for other in sorted(others))})" if others else ""
        return f"There is no {usual}/{nor}. {_folders(root)}", f"put them into {usual}/"
    like = "" if example is None else f" The other images are called like {shown_path(example, root)}."
    leading = next(iter(spectra))
    wanted = (
        "images that are in the COLMAP model"
        if name == leading
        else f"images with the names of their {label(leading)} images"
    )
    return f"{found}{like}", f"give {folder.name}/ {wanted}"


def _images_in(folder: Path) -> str | None:
    """How many images a folder holds and what the first is called; None where there is no such folder."""
    if not folder.is_dir():
        return None
    images = list_images(folder, recursive=True)
    unread = unread_note(folder)
    if images:
        first = f"{folder.name}/ holds {len(images)} images (first: {shown_path(images[0], folder.parent)})."
        return first if unread is None else f"{first} {unread}"
    if unread is not None:
        return unread
    files = files_below(folder)
    if not files:
        return f"{folder.name}/ is empty."
    first = f" (first: {shown_path(files[0], folder.parent)}; read are {' '.join(sorted(IMAGE_SUFFIXES))})"
    return f"{folder.name}/ holds {len(files)} files and no image{first}."


def _folders(root: Path) -> str:
    inside = sorted(root.iterdir()) if root.is_dir() else []  # a capture need not come from a folder
    folders = [path for path in inside if path.is_dir() and not path.name.startswith(".")]
    return f"Found: {', '.join(describe_folder(path) for path in folders) or 'no folders'}."


def shown_path(path: Path, root: Path) -> str:
    """A file's path as messages show it: below the capture's folder where it lies there."""
    return str(path.relative_to(root) if path.is_relative_to(root) else path)
