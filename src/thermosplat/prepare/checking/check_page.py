"""The page of a check: one HTML file with everything in it, pictures included."""

import base64
import html
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.prepare.checking.findings import Finding

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 1040px; margin: 2em auto; padding: 0 1em; color: #222; }
li.warning { color: #9a3412; } img { width: 100%; } figcaption { color: #666; margin-bottom: 1.5em; }
@media (prefers-color-scheme: dark) { body { background: #111; color: #ddd; } li.warning { color: #fdba74; } }
"""


def check_page(
    title: str, findings: Sequence[Finding], estimate: str, pictures: Sequence[tuple[str, NDArray[np.uint8]]]
) -> str:
    """The page.

    Args:
        pictures: A caption and a picture [H, W, 3] for each pair.
    """
    items = "\n".join(f'<li class="{one.level}">{html.escape(one.sentence)}</li>' for one in findings)
    figures = "\n".join(
        f'<figure><img alt="{html.escape(caption)}" src="data:image/jpeg;base64,{_jpeg(picture)}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
        for caption, picture in pictures
    )
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>{html.escape(title)}</title><style>{_STYLE}</style></head><body>
<h1>{html.escape(title)}</h1>
<p>{html.escape(estimate)}</p>
<ul>
{items}
</ul>
<p>Photograph, thermal image, and the thermal image's edges over the photograph. Where the edges do not lie on the same
objects, the pair or the registration is wrong.</p>
{figures}
</body></html>
"""


def _jpeg(picture: NDArray[np.uint8]) -> str:
    data = cv2.imencode(".jpg", np.ascontiguousarray(picture[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
    return base64.b64encode(data.tobytes()).decode()
