"""What the page's script reads, as an element that nobody sees: which tab this is, its picture, wipe and legend."""

import html

from thermosplat.viewer.legend import legend_html
from thermosplat.viewer.session import Shown, ViewSession


def state_html(key: str, version: int, session: ViewSession, shown: Shown | None) -> str:
    """The element.

    Args:
        key: Of the tab; requests of its page name it.
        version: Number of the picture.
        session: What the tab looks at.
        shown: The picture; None: there is none yet.

    Returns:
        HTML; texts are escaped.
    """
    wish = session.wish
    wipe = f"{wish.share:.4f}" if wish.comparison == "wipe" else ""
    size, legend = "", ""
    if shown is not None:
        title = wish.first.label
        if wish.comparison == "wipe":
            title = f"{wish.first.label}  |  {wish.second.label}"
        elif wish.comparison == "blend":
            title = f"{wish.first.label} + {wish.second.label}"
        if wish.over:
            title = f"photograph over {title}"
        below = ["" if shown.full else "moving"]
        if any(image.changed is not None for image in shown.layers.values()):
            reasons = [reason for image in shown.layers.values() for reason in image.reasons]
            below += [session.temperatures.text, *dict.fromkeys(reasons)]
            below += ["hatched: not recalculated"] if reasons and session.temperatures.text else []
        legend = legend_html(title, session.legend(shown), *filter(None, below))
        size = f"{shown.picture.shape[1]}x{shown.picture.shape[0]}"
    return (
        f'<div id="thermosplat-state" style="display:none" data-key="{html.escape(key)}" '
        f'data-wipe="{wipe}" data-version="{version}" data-size="{size}" '
        f'data-full="{int(shown is not None and shown.full)}">{legend}</div>'
    )
