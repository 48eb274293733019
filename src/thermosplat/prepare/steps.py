"""Steps that are done once: what a finished step leaves, and when it has to be done again.

``prepared/<step>.json`` is written last, when all that the step makes is there. It has the step's settings, what its
inputs looked like and what it had to say. A step is skipped as long as these agree, and done again when a setting or an
input has changed. A step that was killed has no such file, so nothing that it left is taken for whole.
"""

import hashlib
import json
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from thermosplat.errors import UserError
from thermosplat.prepare.capture_folder import CaptureFolder
from thermosplat.regular_files import files_below, read_regular
from thermosplat.runs.atomic_writes import write_bytes

STEPS = ("import", "pair", "calibrate", "sfm", "register", "check")
"""All steps in their order."""


@dataclass(frozen=True)
class StepReport:
    """What a step found, in sentences for people.

    Args:
        before: The step was complete already, and nothing was done.
    """

    sentences: tuple[str, ...]
    before: bool = False


def run_step(
    capture: CaptureFolder,
    step: str,
    work: Callable[[], Sequence[str]],
    *,
    settings: Mapping[str, Any],
    inputs: Iterable[Path],
    outputs: Iterable[Path] = (),
    restart: Callable[[], None] | None = None,
) -> StepReport:
    """Do a step, or repeat what it said if it is complete.

    Args:
        step: One of ``STEPS``.
        work: Does the step and returns what it found, in sentences. It may go on with what an interrupted one left.
        settings: All that decides the result, as plain values.
        inputs: Files that it reads, and ``capture.marker(...)`` of the steps before. Folders stand for all files below
            them, each by name, size and time of its last change.
        outputs: Files that must be there for the step to be complete.
        restart: Removes what an earlier attempt with other settings or inputs left, so that ``work`` goes on with
            files of its own only. None: ``work`` replaces all of them anyhow.
    """
    marker, outputs = capture.marker(step), list(outputs)
    wanted = {"settings": json.loads(json.dumps(settings)), "inputs": fingerprint(inputs)}
    earlier = read_marker(capture, step)
    same = earlier is not None and all(earlier.get(key) == value for key, value in wanted.items())
    if earlier is not None and same and all(path.exists() for path in outputs):
        return StepReport(tuple(earlier.get("sentences", ())), before=True)
    try:
        marker.unlink(missing_ok=True)
    except OSError as error:
        raise UserError(f"Cannot replace {marker}: {error.strerror or error}.") from error
    begun = marker.with_suffix(".begun")
    new_folders = [folder for folder in begun.parents if not folder.exists()]
    if restart is not None:
        if _read(begun) != wanted:
            restart()
        write_bytes(begun, json.dumps(wanted).encode())
    started = time.time()
    try:
        sentences = list(work())
    except UserError:
        _remove_if_nothing_else(begun, new_folders)
        raise
    lacking = [path for path in outputs if not path.exists()]
    if lacking:
        raise UserError(f"{step} did not write {lacking[0]}.", "Please report this.")
    content = {**wanted, "sentences": sentences, "finished": time.time(), "seconds": round(time.time() - started, 2)}
    write_bytes(marker, json.dumps(content, indent=1).encode())
    begun.unlink(missing_ok=True)
    return StepReport(tuple(sentences))


def _remove_if_nothing_else(begun: Path, new_folders: Sequence[Path]) -> None:
    """Leave nothing of a step that failed before it wrote anything: neither its mark nor folders made for that."""
    made = new_folders[-1] if new_folders else begun.parents[1]
    if begun.is_file() and all(path == begun for path in made.rglob("*") if not path.is_dir()):
        begun.unlink()
        with suppress(OSError):  # a folder that is not empty stays
            for folder in new_folders:
                folder.rmdir()


def read_marker(capture: CaptureFolder, step: str) -> dict[str, Any] | None:
    """What a complete step left, as ``run_step`` wrote it; None where it is not complete."""
    return _read(capture.marker(step))


def _read(path: Path) -> dict[str, Any] | None:
    try:
        content = json.loads(read_regular(path))
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) else None


def require_step(capture: CaptureFolder, step: str) -> None:
    """Refuse to go on where a step is not complete.

    Raises:
        UserError: It is not.
    """
    if read_marker(capture, step) is None:
        place = f"FOLDER --out {capture.root}" if step == "import" else str(capture.root)
        raise UserError(
            f"{capture.root} is no capture that thermosplat-prepare {step} has finished.",
            f"Do that first: thermosplat-prepare {step} {place}",
        )


def fingerprint(paths: Iterable[Path]) -> str:
    """A digest that changes when one of these files does; files that are not there count as such."""
    digest = hashlib.sha256()
    for path in paths:
        files = files_below(path) if path.is_dir() else [path]
        for file in files:
            digest.update(str(file).encode(errors="surrogateescape"))
            try:
                state = file.stat()
            except OSError:
                digest.update(b"absent")
                continue
            digest.update(f"{state.st_size} {state.st_mtime_ns}".encode())
    return digest.hexdigest()
