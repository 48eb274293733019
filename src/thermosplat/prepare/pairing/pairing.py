"""Which thermal image was taken with which photograph.

Rules, in the order in which they are tried: one source file (a FLIR file with its photograph), the same name without
the words that tell the cameras apart, the same last number in the name, the time in EXIF data or in the name with a
constant difference between the clocks, and the order. The first rule that pairs nearly all images is taken; what it
leaves over is listed. Numbers begin again in other folders: where folders of both cameras agree, images are paired
within them alone.
"""

import re
from collections import Counter
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import PurePosixPath
from typing import Literal

from thermosplat.errors import UserError
from thermosplat.prepare.capture_folder import LEADING, OTHER, CaptureFolder, FrameRow, PairRow
from thermosplat.prepare.counted import counted
from thermosplat.prepare.pairing.clock_offset import find_clock_offset
from thermosplat.prepare.pairing.file_names import folder_key, is_named_by_time, name_key, name_time, number_key
from thermosplat.prepare.steps import StepReport, require_step, run_step

Rule = Literal["auto", "name", "number", "time", "order", "none"]
Pairs = list[tuple[FrameRow, FrameRow]]
_ENOUGH = 0.8
"""Share of the rarer spectrum's images that a rule must pair to be taken without being asked for."""
_SHOWN = 5
_EQUAL_CLOCKS = 0.05
"""Difference [s] up to which two clocks agree."""


def pair_frames(capture: CaptureFolder, rule: Rule = "auto") -> StepReport:
    """Find the pairs and write ``pairs.csv``.

    Args:
        rule: How images are paired; "auto" takes the first rule that pairs nearly all, "none" pairs none.

    Returns:
        Which rule was used and why, and what is left over.

    Raises:
        UserError: The capture has no thermal images, or no rule pairs them.
    """
    require_step(capture, "import")
    return run_step(
        capture,
        "pair",
        lambda: _pair(capture, rule),
        settings={"rule": rule},
        inputs=[capture.marker("import"), capture.frames_csv],
        outputs=[capture.pairs_csv],
    )


def _pair(capture: CaptureFolder, rule: Rule) -> list[str]:
    photographs, thermals = capture.read_frames(LEADING), capture.read_frames(OTHER)
    if not thermals:
        capture.write_pairs([])
        return ["There are no thermal images, so there is nothing to pair."]
    if rule == "none":
        capture.write_pairs([])
        return ["Thermal images have no partners: each finds its own place among the photographs."]
    pairs, sentences = _by_rule(photographs, thermals, rule)
    capture.write_pairs([PairRow(photograph.file, thermal.file) for photograph, thermal in pairs])
    for what, rows in (("photograph", photographs), ("thermal image", thermals)):
        used = {row.file for pair in pairs for row in pair if row in rows}
        left = [row.file for row in rows if row.file not in used]
        if left:
            more = ", ..." if len(left) > _SHOWN else ""
            sentences.append(
                f"{counted(len(left), f'{what} has', f'{what}s have')} no partner: {', '.join(left[:_SHOWN])}{more}."
            )
    return sentences


def _by_rule(photographs: Sequence[FrameRow], thermals: Sequence[FrameRow], rule: Rule) -> tuple[Pairs, list[str]]:
    tried: list[str] = []
    rules: dict[str, Callable[[], tuple[Pairs, list[str]]]] = {
        "source": lambda: _by_key(photographs, thermals, lambda row: row.source, "they come from the same files"),
        "name": lambda: _by_name(photographs, thermals),
        "number": lambda: _by_folder_and(photographs, thermals, number_key, "the last numbers in their names agree"),
        "time": lambda: _by_time(photographs, thermals),
        "order": lambda: _by_order(photographs, thermals, asked=rule == "order"),
    }
    fewest = min(len(photographs), len(thermals))
    for name, find in rules.items():
        if rule not in ("auto", name):
            continue
        pairs, sentences = find()
        if pairs and (rule == name or len(pairs) >= _ENOUGH * fewest):
            return pairs, [
                f"{counted(len(pairs), 'pair')} of {counted(len(photographs), 'photograph')} and "
                f"{counted(len(thermals), 'thermal image')}.",
                *sentences,
            ]
        tried.append(f"by {name} {len(pairs)}")
    raise UserError(
        f"{counted(len(photographs), 'photograph')} and {counted(len(thermals), 'thermal image')} could not be "
        f"paired ({', '.join(tried)}; "
        f"first: {photographs[0].source} and {thermals[0].source}).",
        "Name the files of one moment alike. Or take the rule that fits with --by name, number, time or order.",
    )


def _by_name(photographs: Sequence[FrameRow], thermals: Sequence[FrameRow]) -> tuple[Pairs, list[str]]:
    """Names that agree; of names that are times only those of clocks that agree."""
    pairs, said = _by_folder_and(photographs, thermals, name_key, "their names agree, but for the camera")
    if pairs and all(is_named_by_time(row) for row in (*photographs, *thermals)):
        by_time, _ = _by_time(photographs, thermals)
        if len(by_time) > len(pairs):  # equal seconds of clocks that differ by some seconds
            return [], []
    return pairs, said


def _by_key(
    photographs: Sequence[FrameRow], thermals: Sequence[FrameRow], key: Callable[[FrameRow], str | None], why: str
) -> tuple[Pairs, list[str]]:
    """Pairs of images whose keys agree and are unique in their spectrum."""
    keys = [[key(row) for row in rows] for rows in (photographs, thermals)]
    counts = [Counter(found) for found in keys]
    by_key = {name: row for name, row in zip(keys[1], thermals) if name is not None and counts[1][name] == 1}
    pairs = [
        (row, by_key[name])
        for name, row in zip(keys[0], photographs)
        if name is not None and counts[0][name] == 1 and name in by_key
    ]
    return pairs, [f"Paired because {why}{_clock_of(pairs)}."]


def _by_folder_and(
    photographs: Sequence[FrameRow], thermals: Sequence[FrameRow], key: Callable[[FrameRow], str | None], why: str
) -> tuple[Pairs, list[str]]:
    """Pairs of one folder; across folders only where these say nothing and no key comes twice in a spectrum."""

    def both(row: FrameRow) -> str | None:
        name = key(row)
        return None if name is None else f"{folder_key(row)}/{name}"

    folders = [{folder_key(row) for row in rows} for rows in (photographs, thermals)]
    inside, said = _by_key(photographs, thermals, both, f"{why}{' in each folder' if len(folders[1]) > 1 else ''}")
    if len(inside) >= _ENOUGH * min(len(photographs), len(thermals)):
        return inside, said
    written_together = {_folder(row) for row in photographs} & {_folder(row) for row in thermals}
    names = [[name for row in rows if (name := key(row)) is not None] for rows in (photographs, thermals)]
    begins_again = any(len(set(found)) < len(found) for found in names)
    # one camera's folders may be those of its hundreds (100_FLIR, 101_FLIR), beside one of the other camera
    agree = folders[0] & folders[1] and min(len(one) for one in folders) > 1
    if written_together or begins_again or agree:
        return inside, said
    return _by_key(photographs, thermals, key, why)


def _folder(row: FrameRow) -> str:
    return str(PurePosixPath(row.source.partition("#")[0]).parent)


def _clock_of(pairs: Pairs) -> str:
    """How far the clocks differ in pairs that were found otherwise."""
    differences = sorted(
        two - one for photograph, thermal in pairs if (one := exif_time(photograph)) and (two := exif_time(thermal))
    )
    if not differences:
        return ""
    middle = differences[len(differences) // 2]
    if abs(middle) < _EQUAL_CLOCKS:
        return ""
    return f"; the thermal clock is {_ahead(middle)}"


def _by_time(photographs: Sequence[FrameRow], thermals: Sequence[FrameRow]) -> tuple[Pairs, list[str]]:
    one, two = _timed(photographs), _timed(thermals)
    if len(one) < 3 or len(two) < 3:
        return [], []
    found = find_clock_offset([time for time, _ in one], [time for time, _ in two])
    pairs = [(row, two[partner][1]) for (_, row), partner in zip(one, found.partners) if partner >= 0]
    sentences = [
        f"Paired by time: the thermal clock is {_ahead(found.seconds)} (differences of pairs vary by "
        f"{found.spread:.2f} s in the median)."
    ]
    sentences += [
        f"Warning: near {one[place][1].file} a clock jumps by {change:+.1f} s. Images beyond it are paired with "
        "that change: look at check/ whether that is right."
        for place, change in found.jumps
    ]
    return pairs, sentences


def _timed(rows: Sequence[FrameRow]) -> list[tuple[float, FrameRow]]:
    """Rows with the times in EXIF data or in their names, of which more are different."""
    choices = [[(time, row) for row in rows if (time := moment(row)) is not None] for moment in (exif_time, name_time)]
    timed = max(choices, key=lambda choice: len({time for time, _ in choice}))
    return sorted(timed, key=lambda item: (item[0], item[1].file))


def exif_time(row: FrameRow) -> float | None:
    """The time of an image [s] since 1970; times without a zone count as UTC. None where there is none."""
    if row.time is None:
        return None
    try:
        moment = datetime.fromisoformat(row.time)
    except ValueError:
        return None
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def _ahead(difference: float) -> str:
    if abs(difference) < _EQUAL_CLOCKS:
        return "with that of the photographs"
    return f"{abs(difference):.1f} s {'ahead of' if difference > 0 else 'behind'} that of the photographs"


def _by_order(photographs: Sequence[FrameRow], thermals: Sequence[FrameRow], *, asked: bool) -> tuple[Pairs, list[str]]:
    """The first with the first and so on, by name, in each folder that both have; without being asked only for equally
    many of each."""
    shared = {folder_key(row) for row in photographs} & {folder_key(row) for row in thermals}
    groups: dict[str, list[list[FrameRow]]] = {}
    for side, rows in enumerate((photographs, thermals)):
        for row in sorted(rows, key=_natural):
            groups.setdefault(folder_key(row) if shared else "", [[], []])[side].append(row)
    if not asked and any(len(one) != len(other) for one, other in groups.values()):
        return [], []
    why = "as --by order asks" if asked else "because neither names nor numbers nor times agree"
    pairs = [pair for one, other in groups.values() for pair in zip(one, other)]
    return pairs, [f"Paired by order alone, {why}: look at check/ whether that is right."]


def _natural(row: FrameRow) -> list[tuple[int, str]]:
    """Sorts IR_9 before IR_10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", row.source)]
