"""The folders of a capture that hold its images, and what to say where they do not."""

from collections.abc import Collection
from pathlib import Path

from thermosplat.datasets.colmap_model import THERMAL_FOLDERS, describe_folder
from thermosplat.datasets.image_files import IMAGE_SUFFIXES, list_images


def image_folder(root: Path, name: str, others: Collection[str] = ()) -> Path:
    """A folder by its name in any case, or by another name that means the same.

    Args:
        root: The capture's folder.
        name: The usual name, in lower case.
        others: Other names.

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


def thermal_folder(root: Path) -> Path:
    """The capture's folder of thermal images: thermal/, or one of the names that mean the same to a COLMAP model."""
    return image_folder(root, "thermal", THERMAL_FOLDERS)


def looked_for_thermal(root: Path, rgb: Path | None) -> tuple[str, str]:
    """What was found where thermal images are looked for, and what to do.

    Args:
        root: The capture's folder.
        rgb: An RGB image of it, as an example of a name.
    """
    folder = thermal_folder(root)
    found = _images_in(folder)
    if found is None:
        others = ", ".join(f"{name}/" for name in sorted(THERMAL_FOLDERS - {"thermal"}))
        return f"There is no thermal/ (nor {others}). {_folders(root)}", "put them into thermal/"
    like = "" if rgb is None else f" The RGB images are called like {_relative(rgb, root)}."
    return f"{found}{like}", f"give {folder.name}/ images with the names of their RGB images"


def looked_for_rgb(root: Path, thermal: Path | None) -> tuple[str, str]:
    """As ``looked_for_thermal``, for RGB images.

    Args:
        root: The capture's folder.
        thermal: A thermal image of it.
    """
    folder = next((path for name in ("rgb", "images") if (path := image_folder(root, name)).is_dir()), None)
    found = None if folder is None else _images_in(folder)
    if found is None or folder is None:
        return f"There is no rgb/ and no images/. {_folders(root)}", "put them into images/"
    like = "" if thermal is None else f" The thermal images are called like {_relative(thermal, root)}."
    return f"{found}{like}", f"give {folder.name}/ the images that are in the COLMAP model"


def _images_in(folder: Path) -> str | None:
    """How many images a folder holds and what the first is called; None where there is no such folder."""
    if not folder.is_dir():
        return None
    images = list_images(folder, recursive=True)
    if images:
        return f"{folder.name}/ holds {len(images)} images (first: {_relative(images[0], folder.parent)})."
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    if not files:
        return f"{folder.name}/ is empty."
    first = f" (first: {_relative(files[0], folder.parent)}; read are {' '.join(sorted(IMAGE_SUFFIXES))})"
    return f"{folder.name}/ holds {len(files)} files and no image{first}."


def _folders(root: Path) -> str:
    inside = sorted(root.iterdir()) if root.is_dir() else []  # a capture need not come from a folder
    folders = [path for path in inside if path.is_dir() and not path.name.startswith(".")]
    return f"Found: {', '.join(describe_folder(path) for path in folders) or 'no folders'}."


def _relative(path: Path, root: Path) -> str:
    return str(path.relative_to(root) if path.is_relative_to(root) else path)
