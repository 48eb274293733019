"""The chapter of a report on what changed since an earlier date, from a folder of thermosplat-compare."""

from collections.abc import Iterator
from pathlib import Path

from thermosplat.errors import UserError
from thermosplat.pictures.image_display import Image8, read_png
from thermosplat.reporting.blocks import Block, Heading, Paragraph, Picture, Table
from thermosplat.reporting.texts import Words
from thermosplat.spectra import CELSIUS, unit_label
from thermosplat.thermography.comparison_file import PICTURED, KnownComparison, LaterDate, change_picture, plan_picture


def changes_since(comparison: KnownComparison, date: LaterDate, words: Words) -> Iterator[Block]:
    """What changed from the first date to one of the others.

    Args:
        comparison: The comparison.
        date: The later date, which the report is of.
        words: Texts of the report's language.
    """
    unit = "K" if comparison.unit == CELSIUS else unit_label(comparison.unit)
    length = "m" if comparison.length_unit == "m" else words["world_units"]
    shift = f"{words.number(date.shift, 2, sign=True)} ± {words.number(date.shift_plus_minus, 2)} {unit}"
    yield Heading(words["changes"].format(comparison.first), new_page=True)
    yield Paragraph(words["shift"].format(shift))
    if not date.changes:
        yield Paragraph(words["no_changes"])
        return
    ends = f"{words.number(-date.span, 1)} {unit} – {words.number(date.span, 1, sign=True)} {unit}"
    yield Picture(_read(comparison.folder / plan_picture(date.number)), words["plan_changes"].format(ends))
    rows = [
        (
            f"{one.number} {words[one.kind]}",
            words.place(one.place, 2),
            f"{words.formatted(one.area, '.3g')} {length}²",
            f"{words.number(one.difference, 2, sign=True)} ± {words.number(one.plus_minus, 2)} {unit}",
            f"{words.number(one.height, 2, sign=True)} {length}",
        )
        for one in date.changes
    ]
    yield Table([words[name] for name in ("change", "east_north", "area", "change_by", "height")], rows)
    for one in date.changes[:PICTURED]:
        picture = _read(comparison.folder / change_picture(date.number, one.number))
        yield Picture(picture, f"{one.number} {words[one.kind]}: {comparison.first} | {date.name}", 0.75)


def _read(path: Path) -> Image8:
    """A picture of the comparison.

    Raises:
        UserError: It is not there.
    """
    picture = read_png(path)
    if picture is None:
        raise UserError(f"{path} is no picture that can be read.", "Run thermosplat-compare again.")
    return picture
