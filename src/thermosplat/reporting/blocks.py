"""What a report consists of, before it is HTML or PDF: both print the same blocks in the same order."""

from collections.abc import Sequence
from dataclasses import dataclass

from thermosplat.pictures.image_display import Image8


@dataclass(frozen=True)
class Heading:
    """A title."""

    text: str
    level: int = 2
    """1: of the report; 2: of a chapter; 3: of a part of it."""
    new_page: bool = False
    """Whether it begins a page."""


@dataclass(frozen=True)
class Paragraph:
    """Some sentences."""

    text: str
    stands_out: bool = False
    """Whether nobody should miss it."""


@dataclass(frozen=True)
class Facts:
    """Labels and what they stand for, a row each."""

    rows: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Table:
    """A table with a head."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture with a line below."""

    image: Image8
    """8-bit RGB, [H, W, 3]."""
    caption: str
    share: float = 1.0
    """Of the page's width, at most."""


Block = Heading | Paragraph | Facts | Table | Picture
