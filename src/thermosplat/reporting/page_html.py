"""A report as one HTML file: no script, no other file, no network; it prints on A4."""

import base64
import html
from collections.abc import Sequence

import cv2

from thermosplat.printing import printable
from thermosplat.reporting.blocks import Block, Facts, Heading, Paragraph, Picture, Table

_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
_STYLE = """
@page { size: A4; margin: 18mm; }
body { font: 15px/1.45 system-ui, sans-serif; max-width: 860px; margin: 2em auto; padding: 0 1em; color: #1f2937;
  overflow-wrap: anywhere; }
h1 { font-size: 1.7em; } h2 { font-size: 1.3em; margin-top: 1.6em; } h3 { font-size: 1.1em; margin-top: 1.6em; }
table { border-collapse: collapse; width: 100%; } th, td { padding: .25em .7em; border-bottom: 1px solid #d1d5db;
  text-align: left; vertical-align: top; white-space: pre-line; } .facts th { width: 38%; font-weight: 500;
  color: #4b5563; } .wide { overflow-x: auto; } .wide th, .wide td { min-width: 6em; padding: .25em .4em; }
p { white-space: pre-line; } .stands-out { border-left: 4px solid #b45309; padding-left: .8em; }
figure { margin: 1em 0; break-inside: avoid; } img { max-width: 100%; } figcaption { color: #6b7280; font-size: .9em; }
@media print { body { margin: 0; max-width: none; padding: 0; font-size: 10.5pt; } .new-page { break-before: page; }
  .wide th, .wide td { min-width: 0; }
  h2, h3 { break-after: avoid; } tr { break-inside: avoid; } }
"""


def html_of(blocks: Sequence[Block], language: str) -> str:
    """The file's text.

    Args:
        blocks: The report.
        language: "en" or "de".
    """
    title = next((block.text for block in blocks if isinstance(block, Heading)), "")
    body = "\n".join(_block(block) for block in blocks)
    return f"""<!doctype html>
<html lang="{language}"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<meta http-equiv="Content-Security-Policy" content="{_POLICY}">
<title>{_text(title)}</title><style>{_STYLE}</style></head><body>
{body}
</body></html>
"""


def png_of(picture: Picture) -> bytes:
    """A picture as a PNG file."""
    return bytes(cv2.imencode(".png", cv2.cvtColor(picture.image, cv2.COLOR_RGB2BGR))[1])


def _block(block: Block) -> str:
    if isinstance(block, Heading):
        start = ' class="new-page"' if block.new_page else ""
        return f"<h{block.level}{start}>{_text(block.text)}</h{block.level}>"
    if isinstance(block, Paragraph):
        start = ' class="stands-out"' if block.stands_out else ""
        return f"<p{start}>{_text(block.text)}</p>"
    if isinstance(block, Facts):
        rows = "".join(f"<tr><th>{_text(name)}</th><td>{_text(value)}</td></tr>" for name, value in block.rows)
        return f'<table class="facts">{rows}</table>'
    if isinstance(block, Table):
        head = "".join(f"<th>{_text(name)}</th>" for name in block.head)
        rows = "".join(f"<tr>{''.join(f'<td>{_text(cell)}</td>' for cell in row)}</tr>" for row in block.rows)
        return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'
    data = base64.b64encode(png_of(block)).decode()
    picture = f'<img alt="" style="width: {block.share:.0%}" src="data:image/png;base64,{data}">'
    return f"<figure>{picture}<figcaption>{_text(block.caption)}</figcaption></figure>"


def _text(text: str) -> str:
    return html.escape(printable(text, lines=True))
