"""HTML and PDF of the same blocks: complete, and nothing in a text is markup."""

import re

import numpy as np
import pytest

from thermosplat.reporting.blocks import Block, Facts, Heading, Paragraph, Picture, Table
from thermosplat.reporting.page_html import html_of
from thermosplat.reporting.page_pdf import pdf_of
from thermosplat.reporting.texts import FORM, TEXTS, Words

HOSTILE = ["<script>alert(1)</script>", "</para><b>", "a & b &lt;", "\x1b[2J\udcff", "Ü " + "x" * 3000, "屋顶 😀 ΔT"]


def _blocks(text: str) -> list[Block]:
    picture = Picture(np.zeros((40, 60, 3), np.uint8), text)
    facts, table = Facts([(text, text)]), Table([text, "b"], [(text, "c")] * 3)
    return [Heading(text, 1), Paragraph(text), facts, Heading(text, 2, new_page=True), table, picture]


@pytest.mark.parametrize("text", HOSTILE)
def test_hostile_texts(text: str) -> None:
    """They are printed as they are; no tag and no control character of theirs is left."""
    page = html_of(_blocks(text), "en")
    assert "<script" not in page
    assert "\x1b" not in page
    assert "http" not in page.replace("http-equiv", "")
    page.encode()
    pdf = pdf_of(_blocks(text), "en")
    assert pdf.startswith(b"%PDF")
    assert len(re.findall(rb"/Type /Page\b", pdf)) >= 2
    assert b"ASCII85Decode" not in pdf


def test_pages_are_counted() -> None:
    """A page for each heading that begins one."""
    blocks: list[Block] = [Heading(str(number), 2, new_page=number > 0) for number in range(5)]
    assert len(re.findall(rb"/Type /Page\b", pdf_of(blocks, "de"))) == 5
    assert html_of(blocks, "de").count('class="new-page"') == 4


def test_both_languages_are_complete() -> None:
    """Each text is there twice, with the same gaps; German numbers have commas."""
    for english, german in (*TEXTS.values(), *FORM.values()):
        assert english
        assert german
        assert english.count("{}") == german.count("{}")
    said = "23.41 ± 0.2 °C (recalculated) (20.10 to 30.00, std 1.20)"
    assert Words("en").told(said) == said
    assert Words("de").told(said) == "23,41 ± 0,2 °C (umgerechnet) (20,10 bis 30,00, Std.-Abw. 1,20)"
    assert Words("de").number(18.6, 1, sign=True) == "+18,6"
