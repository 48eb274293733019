"""What the commands write into a result folder: by which names their files are told from those of others.

A result folder may lie anywhere, and other trainers have folders of the same names. Deleting goes by these names, and
never through a link.
"""

import contextlib
import csv
import re
from collections.abc import Iterator
from pathlib import Path

from thermosplat.runs.atomic_writes import check_is_no_link, is_temporary, sweep

TENSORBOARD_SUFFIX = ".thermosplat"
"""At the end of our event files' names, by which they are told from those of other trainers."""
FILES = ("config.yaml", "metrics.json", "metrics.jsonl", "regions.json", "environment.json", "geo.json")
"""What lies in the result folder itself."""
PAGE, PAGE_MARK = "index.html", "<!-- results of thermosplat -->"
"""The page of a result folder, and what tells it from other pages of that name."""
PIXELS = "pixels"
"""The folder of undistorted images of a capture that does not fit the memory, as long as it is trained on."""
KEPT_PIXELS = re.compile(r"[0-9a-f]{32}\.(image|values|intensity|mask)\.npy")
"""Their names: what they were made of, and which array they hold."""
CHECKPOINT_NAME = re.compile(r"step_(\d+)\.pt")
"""With the steps done."""

_SPECTRUM = "[a-z][a-z0-9_]*"
_ON_CAPTURE = r"\d{6,}(_.+)?"  # a step, and the name of another capture than the run's own
_WRITTEN = {
    "ckpts": CHECKPOINT_NAME.pattern,
    PIXELS: KEPT_PIXELS.pattern,
    "stats": rf"step_\d{{6,}}\.json|per_view\.csv|(eval|regions)_{_ON_CAPTURE}\.(json|csv)",
    "renders": rf"eval_{_ON_CAPTURE}",
    "ply": rf"splat_{_SPECTRUM}\.ply|geo\.json",
    "exports": rf"(splat|points|mesh|orthomosaic)_{_SPECTRUM}\.(compressed\.ply|ply|spz|sog|glb|usd|tif|las)|geo\.json",
    "videos": rf"(interp|ellipse|spiral|train|test|bookmarks)(-wipe|-inset)?_{_SPECTRUM}(-{_SPECTRUM})*_{_ON_CAPTURE}",
    "refined": r"(cameras|images|points3D)\.txt",
    "tb": rf"events\.out\.tfevents\..*{re.escape(TENSORBOARD_SUFFIX)}",
}
"""Names of what is written into each folder, strips in renders/ apart: those have the frames' names."""


def delete_run(run: Path) -> None:
    """Delete what the commands wrote into a result folder, and what killed ones left there. All else stays.

    Args:
        run: The result folder.

    Raises:
        NotWrittenError: A folder in it is a link; nothing has been deleted then.
    """
    for name in _WRITTEN:
        check_is_no_link(run / name)
    strips = _strips(run)
    for name in _WRITTEN:
        for entry in _entries(run / name):
            if _is_ours(name, entry) and entry.is_dir() and not entry.is_symlink():
                for picture in (*entry.glob("*.png"), *entry.glob("*.tiff")):
                    picture.unlink()
                sweep(entry)
                _remove_if_empty(entry)
            elif _is_ours(name, entry) or entry in strips or is_temporary(entry.name):
                entry.unlink()  # of a link: the link itself
        _remove_if_empty(run / name)
    for name in FILES:
        (run / name).unlink(missing_ok=True)
    if is_our_page(run / PAGE):
        (run / PAGE).unlink()


def is_our_page(path: Path) -> bool:
    """Whether a file is a page that a command wrote: it says so at its beginning.

    Args:
        path: The file; it may be missing.
    """
    try:
        if path.is_symlink() or not path.is_file():
            return False
        with path.open("rb") as file:
            return PAGE_MARK.encode() in file.read(200)
    except OSError:
        return False


def sweep_run(run: Path) -> None:
    """Delete the temporary files that killed processes left in a result folder.

    Args:
        run: The result folder.
    """
    sweep(run)
    for name in _WRITTEN:
        if not (run / name).is_symlink():
            sweep(run / name)
            for entry in _entries(run / name):
                if _is_ours(name, entry) and not entry.is_symlink():
                    sweep(entry)


def _is_ours(folder: str, entry: Path) -> bool:
    """Whether an entry of one of the folders has a name that a command gives."""
    return re.fullmatch(_WRITTEN[folder], entry.stem if entry.suffix == ".mp4" else entry.name) is not None


def _entries(folder: Path) -> Iterator[Path]:
    if folder.is_dir():
        yield from list(folder.iterdir())


def _strips(run: Path) -> set[Path]:
    """The strips of the held-out frames, by the table of their numbers."""
    try:
        with (run / "stats" / "per_view.csv").open(newline="", encoding="utf-8") as file:
            frames = {row.get("frame") or "" for row in csv.DictReader(file)}
    except (OSError, ValueError, csv.Error):
        return set()
    return {run / "renders" / f"{frame.replace('/', '_')}.png" for frame in frames}


def _remove_if_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):  # not there, or something else is in it
        folder.rmdir()
