"""``shutter.json`` of a capture: which cameras read their images line by line, and how long that takes.

    {"thermal": {"readout": 0.016, "interval": 0.033, "direction": "top-to-bottom"}}

By spectrum: the time from the first line to the last, and the time between one frame and the next in the same unit.
Without "interval" the times are those of ``frames.csv``. "poses" in place of "readout" states the poses themselves:
{"0001.png": [[4x4 at the first line], [4x4 at the last]]}, world to camera.
"""

import csv
import io
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from thermosplat.config.values import shown
from thermosplat.datasets.frame_files import FrameFiles, Shot
from thermosplat.datasets.images.image_files import list_images
from thermosplat.datasets.placement import Placement
from thermosplat.datasets.readouts import LineOrder, Readout, motion_of, paces
from thermosplat.errors import UserError
from thermosplat.regular_files import read_regular
from thermosplat.spectra import label
from thermosplat.thermal.temperature_units import read_json

SHUTTER_FILE = "shutter.json"
"""Name of the file in the capture's folder."""
TABLE = "frames.csv"
"""The table of images that thermosplat-prepare writes, with their times."""
_KEYS = ("direction", "readout", "interval", "poses")
_LONGEST = 1e9
"""Times are at most this, in whatever unit."""
_LARGEST_TURN = np.radians(90.0)
"""Of a camera during one readout: more is a mistake in the times, or poses of different images."""
_FROM_VIDEO = re.compile(r"^(.*)#(\d{1,9})$")
"""The source of a frame of a video in the table; no video has frames of longer numbers."""
_HINT = "docs/data-layouts.md describes it; remove the file if all lines are read at once."


@dataclass(frozen=True, eq=False)
class _Statement:
    """What the file says of one spectrum."""

    order: LineOrder
    readout: float | None
    interval: float | None
    poses: Mapping[str, NDArray[np.float64]] | None


def readouts(
    root: Path, frames: Sequence[FrameFiles], placement: Placement
) -> tuple[dict[tuple[str, str], Readout], list[str]]:
    """The readouts of a capture's images by names of frame and spectrum, and what the user should be told.

    Args:
        root: The capture's folder; without ``shutter.json`` in it, all images are taken at once.
        frames: Its frames, in the order of their names, with poses in the scene's frame.
        placement: Where the scene lies in the world, whose poses the file states.

    Raises:
        UserError: The file is damaged, or the motion cannot be known.
    """
    path = root / SHUTTER_FILE
    if not path.is_file():
        return {}, []
    found: dict[tuple[str, str], Readout] = {}
    notes = []
    for spectrum, stated in read_json(path).items():
        statement = _statement(path, spectrum, stated)
        shots = {frame.name: frame.shots[spectrum] for frame in frames if spectrum in frame.shots}
        if not shots:
            continue  # a spectrum that is not modelled
        if statement.poses is not None:
            of_spectrum = _stated_motions(path, spectrum, statement, shots, placement)
        else:
            of_spectrum = _neighbours_motions(root, spectrum, statement, shots)
        found |= {(frame, spectrum): readout for frame, readout in of_spectrum.items()}
        in_world = [readout.scaled(placement.unit) for readout in of_spectrum.values()]
        notes.append(_note(spectrum, statement.order, in_world))
    return found, notes


def _statement(path: Path, spectrum: str, stated: Any) -> _Statement:
    """What is said of a spectrum, checked."""
    where = f"{path}: {spectrum}"
    if not isinstance(stated, dict) or not set(stated) <= set(_KEYS):
        raise UserError(f"{where} must be an object with {', '.join(_KEYS)}, found {shown(stated)}.", _HINT)
    order = stated.get("direction", "top-to-bottom")
    if order not in get_args(LineOrder):
        raise UserError(f"{where}: direction must be one of {', '.join(get_args(LineOrder))}, found {shown(order)}.")
    if ("readout" in stated) == ("poses" in stated):
        raise UserError(f"{where} must have either readout or poses, found {shown(sorted(stated))}.", _HINT)
    if "poses" in stated:
        return _Statement(order, None, None, _poses(where, stated["poses"]))
    return _Statement(
        order, _positive(where, "readout", stated), _positive(where, "interval", stated, optional=True), None
    )


def _positive(where: str, key: str, stated: Mapping[str, Any], *, optional: bool = False) -> float | None:
    value = stated.get(key)
    if optional and value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value <= _LONGEST:
        raise UserError(f"{where}: {key} must be a time above 0 and at most {_LONGEST:g}, found {shown(value)}.", _HINT)
    return float(value)


def _poses(where: str, stated: Any) -> dict[str, NDArray[np.float64]]:
    """Poses at the first and the last line by file name, [2, 4, 4] each."""
    if not isinstance(stated, dict):
        raise UserError(f"{where}: poses must be an object of file names, found {shown(stated)}.", _HINT)
    poses = {}
    for name, pair in stated.items():
        try:
            found = np.array(pair, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            found = np.empty(0)
        if found.shape != (2, 4, 4):
            raise UserError(
                f"{where}: the poses of {name} must be two 4x4 matrices, at the first line and at the last.", _HINT
            )
        if not _are_rigid(found):
            raise UserError(
                f"{where}: the poses of {name} are no rigid motions from the world to the camera.",
                "Rotations in the first three columns, without scale; the last row is 0 0 0 1.",
            )
        poses[name] = found
    return poses


def _are_rigid(poses: NDArray[np.float64]) -> bool:
    if not (np.isfinite(poses).all() and np.allclose(poses[:, 3], (0, 0, 0, 1))):
        return False
    rotations = poses[:, :3, :3]
    straight = np.allclose(rotations @ rotations.transpose(0, 2, 1), np.eye(3), atol=1e-3)
    return bool(straight and np.linalg.det(rotations).min() > 0)


def _stated_motions(
    path: Path, spectrum: str, statement: _Statement, shots: Mapping[str, Shot], placement: Placement
) -> dict[str, Readout]:
    """Readouts whose poses the file states, by frame."""
    poses = statement.poses or {}
    missing = [shot.path.name for shot in shots.values() if shot.path.name not in poses]
    if missing:
        raise UserError(
            f"{path}: {spectrum} has no poses of {len(missing)} of {len(shots)} images (first: {missing[0]}).",
            "Give the poses of all images, by the name of the file.",
        )
    found = {}
    for name, shot in shots.items():
        stated = placement.viewmat_to_scene(poses[shot.path.name])
        found[name] = Readout(statement.order, stated @ np.linalg.inv(shot.viewmat))
        _check_turn(spectrum, shot.path.name, _turn(found[name]))
    return found


def _neighbours_motions(
    root: Path, spectrum: str, statement: _Statement, shots: Mapping[str, Shot]
) -> dict[str, Readout]:
    """Readouts during which a camera moves as the poses of the images before and after say, by frame."""
    assert statement.readout is not None  # noqa: S101  a statement without poses has one
    found = {}
    for names, times in _sequences(root, spectrum, statement.interval, shots):
        if len(names) < 2:
            raise UserError(
                f"{shots[names[0]].path.name} has no image before or after it in time, so how its camera moves during "
                "the readout is not known.",
                f'State the poses in {SHUTTER_FILE} ("poses"), or leave this image out.',
            )
        viewmats = np.stack([shots[name].viewmat for name in names])
        for name, turn, move in zip(names, *paces(viewmats, times), strict=True):
            _check_turn(spectrum, shots[name].path.name, statement.readout * float(np.linalg.norm(turn)))
            motion = motion_of(shots[name].viewmat, statement.readout * turn, statement.readout * move)
            found[name] = Readout(statement.order, motion)
    return found


def _sequences(
    root: Path, spectrum: str, interval: float | None, shots: Mapping[str, Shot]
) -> list[tuple[list[str], NDArray[np.float64]]]:
    """Frames that were taken one after the other, with their times: one sequence per video or folder, or one of all."""
    rows = _table(root, spectrum)
    sources = {name: rows.get(_below(shot.path, root, spectrum), {}) for name, shot in shots.items()}
    timed: dict[str, list[tuple[float, str]]] = defaultdict(list)
    places = _places(shots)
    for name, row in sources.items():
        time, video, sequence = None, _FROM_VIDEO.match(row.get("source") or ""), ""
        if video is not None:
            sequence = video[1]
        if interval is not None and video is not None:
            time = interval * int(video[2])
        elif interval is not None:
            sequence, place = places[name]
            time = interval * place
        else:
            time = _seconds(row.get("time"))
        if time is None:
            raise UserError(
                f"When {shots[name].path.name} was taken is not known: {TABLE} has no time of it.",
                f'State the time between frames in {SHUTTER_FILE} ("interval"), in the unit of "readout".',
            )
        timed[sequence].append((time, name))
    sequences = []
    for found in timed.values():
        found.sort()
        times = np.array([time for time, _ in found])
        if (np.diff(times) <= 0).any():
            at = int(np.argmax(np.diff(times) <= 0))
            one, other = (shots[found[index][1]].path.name for index in (at, at + 1))
            raise UserError(
                f"{one} and {other} were taken at the same time, by {TABLE}, so how the camera moves is not known.",
                f'State the time between frames in {SHUTTER_FILE} ("interval"), in the unit of "readout".',
            )
        sequences.append(([name for _, name in found], times))
    return sequences


def _places(shots: Mapping[str, Shot]) -> dict[str, tuple[str, int]]:
    """The sequence of each frame, and its place there in the order of the files' names.

    Files without a pose are frames of the sequence, too. Folders are one sequence, as those of training and test images
    are, unless they share names: then each numbers its own.
    """
    apart = len({shot.path.name for shot in shots.values()}) < len(shots)
    sequences = {name: str(shot.path.parent) if apart else "" for name, shot in shots.items()}
    files: dict[str, set[str]] = defaultdict(set)
    for folder in {shot.path.parent for shot in shots.values()}:
        files[str(folder) if apart else ""] |= {path.name for path in list_images(folder)}
    for name, sequence in sequences.items():
        files[sequence].add(shots[name].path.name)
    places = {sequence: {file: place for place, file in enumerate(sorted(found))} for sequence, found in files.items()}
    return {name: (sequence, places[sequence][shots[name].path.name]) for name, sequence in sequences.items()}


def _table(root: Path, spectrum: str) -> dict[str, dict[str, str]]:
    """Rows of the table of images by file below ``images/<spectrum>/``; none without a table."""
    path = root / TABLE
    if not path.is_file():
        return {}
    try:
        with io.StringIO(read_regular(path).decode("utf-8-sig"), newline="") as file:
            rows = [row for row in csv.DictReader(file) if row.get("spectrum") == spectrum and row.get("file")]
    except (OSError, ValueError, csv.Error) as error:
        raise UserError(f"Cannot read {path}: {error}.", "Make it again: thermosplat-prepare import.") from error
    return {str(row["file"]): row for row in rows}


def _below(path: Path, root: Path, spectrum: str) -> str:
    folder = root / "images" / spectrum
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else path.name


def _seconds(text: str | None) -> float | None:
    """A time of the table [s]; one without a zone counts as UTC. None where there is none."""
    try:
        moment = datetime.fromisoformat(text or "")
    except ValueError:
        return None
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def _check_turn(spectrum: str, name: str, turn: float) -> None:
    """Refuse a turn [rad] that no camera makes during a readout."""
    if not turn <= _LARGEST_TURN:  # also where it is not a number
        raise UserError(
            f"By {SHUTTER_FILE} the {label(spectrum)} camera of {name} would turn by {np.degrees(turn):.0f} degrees "
            "while its lines are read.",
            "Are readout and interval in one unit, and the poses those of this image?",
        )


def _turn(readout: Readout) -> float:
    """By how much a camera turns during a readout [rad]."""
    first, last = readout.motion[:, :3, :3]
    return float(np.arccos(np.clip((np.trace(last @ first.T) - 1) / 2, -1, 1)))


def _note(spectrum: str, order: LineOrder, found: Sequence[Readout]) -> str:
    turns = np.degrees([_turn(readout) for readout in found])
    moves = [np.linalg.norm(last[:3, 3] - first[:3, 3]) for first, last in (readout.motion for readout in found)]
    return (
        f"{label(spectrum)} images are read line by line ({order.replace('-', ' ')}): meanwhile the camera turns by "
        f"{np.median(turns):.2g} degrees and moves by {np.median(moves):.2g} world units in the median."
    )
