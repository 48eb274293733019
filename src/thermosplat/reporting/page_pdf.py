"""A report as PDF on A4, by ReportLab (BSD), which installs with pip alone."""

import io
from collections.abc import Sequence
from types import ModuleType
from typing import Any
from xml.sax.saxutils import escape

from thermosplat.errors import UserError
from thermosplat.printing import printable
from thermosplat.reporting.blocks import Block, Facts, Heading, Paragraph, Table
from thermosplat.reporting.page_html import png_of

_MARGIN = 50.0
"""[pt]; 18 mm."""
_GREY = "#d1d5db"
_OTHER_SIGNS = {"Δ": "\u2206"}
"""Signs that the font lacks, and what looks the same there."""
_TALLEST = 560.0
"""Of a picture [pt]: its caption and a heading are on the same page."""
_LONGEST_CELL = 900
"""Letters of a table's cell that stay in the row: a row is no higher than a page."""


def pdf_library() -> ModuleType:
    """ReportLab.

    Raises:
        UserError: It is not installed.
    """
    try:
        import reportlab
    except ImportError as error:
        raise UserError(
            "A report as PDF needs ReportLab, which is not installed.",
            'pip install ".[report]", or give --format html.',
        ) from error
    module: ModuleType = reportlab
    return module


def pdf_of(blocks: Sequence[Block], language: str) -> bytes:
    """The file's content.

    Args:
        blocks: The report.
        language: "en" or "de".

    Raises:
        UserError: ReportLab is not installed.
    """
    pdf_library()
    from reportlab import rl_config
    from reportlab.lib.pagesizes import A4
    from reportlab.platypus import SimpleDocTemplate

    page = _Page(A4[0] - 2 * _MARGIN - 12)
    title = next((block.text for block in blocks if isinstance(block, Heading)), "")
    file = io.BytesIO()
    edges = {f"{side}Margin": _MARGIN for side in ("left", "right", "top", "bottom")}
    document = SimpleDocTemplate(file, pagesize=A4, title=printable(title), lang=language, **edges)
    story = [part for block in blocks for part in page.parts(block)]
    usual, rl_config.useA85 = rl_config.useA85, 0  # bytes as letters, one by one in Python, make a larger file
    try:
        document.build(story, onFirstPage=_numbered, onLaterPages=_numbered)
    finally:
        rl_config.useA85 = usual
    return file.getvalue()


def _numbered(canvas: Any, document: Any) -> None:
    canvas.setFont(_FONT, 8)
    canvas.drawRightString(document.pagesize[0] - _MARGIN, _MARGIN / 2, str(document.page))


_FONT, _BOLD = "Report", "ReportBold"


class _Page:
    """Blocks as parts of ReportLab's pages.

    Args:
        width: Of the text [pt].
    """

    def __init__(self, width: float) -> None:
        from reportlab.lib.styles import ParagraphStyle
        from reportlab.pdfbase import pdfmetrics
        from reportlab.pdfbase.ttfonts import TTFont

        for name, file in ((_FONT, "Vera.ttf"), (_BOLD, "VeraBd.ttf")):  # ReportLab brings them
            if name not in pdfmetrics.getRegisteredFontNames():
                pdfmetrics.registerFont(TTFont(name, file))
        self._signs = set(pdfmetrics.getFont(_FONT).face.charToGlyph)
        self._width = width

        def style(name: str, size: float, before: float, **more: Any) -> ParagraphStyle:
            return ParagraphStyle(
                name,
                **{"fontName": _FONT, "fontSize": size, "leading": 1.35 * size, "spaceBefore": before} | more,
            )

        bold = {"fontName": _BOLD, "spaceAfter": 6, "keepWithNext": 1, "splitLongWords": 1}
        self._headings = {1: style("h1", 18, 0, **bold), 2: style("h2", 13, 14, **bold), 3: style("h3", 11, 12, **bold)}
        self._plain = style("p", 9, 4)
        self._strong = style("strong", 9, 4, fontName=_BOLD)
        self._cell = style("cell", 8, 0)
        self._caption = style("caption", 8, 2, textColor="#6b7280")

    def parts(self, block: Block) -> list[Any]:
        """A block."""
        from reportlab.platypus import Image, KeepTogether, PageBreak

        if isinstance(block, Heading):
            heading = self._paragraph(block.text, self._headings[block.level])
            return [PageBreak(), heading] if block.new_page else [heading]
        if isinstance(block, Paragraph):
            return [self._paragraph(block.text, self._strong if block.stands_out else self._plain)]
        if isinstance(block, Facts):
            return [self._table(block.rows, [0.38, 0.62])] if block.rows else []
        if isinstance(block, Table):
            return [self._table([block.head, *block.rows], [1 / len(block.head)] * len(block.head), head=True)]
        height, width = block.image.shape[:2]
        wide = min(block.share * self._width, _TALLEST * width / height)
        image = Image(io.BytesIO(png_of(block)), wide, wide * height / width, hAlign="LEFT")
        return [KeepTogether([image, self._paragraph(block.caption, self._caption)])]

    def _table(self, rows: Sequence[Sequence[str]], shares: Sequence[float], *, head: bool = False) -> Any:
        from reportlab.platypus import Table as Grid

        cells = [[part for cell in row for part in [self._cells(cell)]] for row in rows]
        style = [
            ("LINEBELOW", (0, 0), (-1, -1), 0.5, _GREY),
            ("VALIGN", (0, 0), (-1, -1), "TOP"),
            ("LEFTPADDING", (0, 0), (-1, -1), 2),
        ]
        widths = [share * self._width for share in shares]
        return Grid(cells, colWidths=widths, style=style, hAlign="LEFT", repeatRows=int(head), splitInRow=1)

    def _cells(self, text: str) -> list[Any]:
        pieces = [text[start : start + _LONGEST_CELL] for start in range(0, len(text), _LONGEST_CELL)] or [""]
        return [self._paragraph(piece, self._cell) for piece in pieces]

    def _paragraph(self, text: str, style: Any) -> Any:
        from reportlab.platypus import Paragraph as Text

        return Text(escape(self._shown(text)).replace("\n", "<br/>"), style)

    def _shown(self, text: str) -> str:
        """A text in the signs of the font."""
        known = (_OTHER_SIGNS.get(sign, sign) for sign in printable(text, lines=True))
        return "".join(sign if sign == "\n" or ord(sign) in self._signs else "?" for sign in known)
