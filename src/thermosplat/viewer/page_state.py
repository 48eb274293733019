"""What the page's script reads, as an element that nobody sees: which tab this is, its picture, wipe and legend."""

import html

from thermosplat.pictures.color_bar import tick_labels, tick_values
from thermosplat.pictures.image_display import rgb_bytes
from thermosplat.thermal.radiometry import Palette
from thermosplat.viewer.session import ViewSession
from thermosplat.viewer.wish import Shown


def state_html(key: str, version: int, session: ViewSession, shown: Shown | None) -> str:
    """The element.

    Args:
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


_STOPS = 24
HEIGHT = 190
"""Of the colour bar [px]."""


def legend_html(title: str, bar: tuple[Palette, float, float, str] | None, *below: str) -> str:
    """What stands in the lower left corner.

    Args:
        bar: Palette, values at its ends and their unit; None: no colour bar.

    Returns:
        HTML; texts are escaped.
    """
    parts = []
    if bar is not None:
        palette, low, high, unit = bar
        colors = [rgb_bytes(palette.to_color(share / (_STOPS - 1))) for share in range(_STOPS)]
        gradient = ", ".join(f"rgb({r},{g},{b})" for r, g, b in colors)
        ticks = tick_values(low, high, 6)
        marks = "".join(
            f'<div style="position:absolute;left:24px;bottom:{(tick - low) / ((high - low) or 1.0) * 100:.2f}%;'
            f'transform:translateY(50%)">{html.escape(text)}</div>'
            for tick, text in zip(ticks, tick_labels(ticks))
        )
        parts.append(
            f'<div style="margin-bottom:10px">{html.escape(unit)}</div>'
            f'<div style="position:relative;height:{HEIGHT}px;width:16px;border:1px solid rgba(255,255,255,.75);'
            f'border-radius:3px;background:linear-gradient(to top, {gradient})">{marks}</div>'
        )
    parts.append(f'<div style="margin-top:12px;font-weight:600;font-size:14px">{html.escape(title)}</div>')
    parts += [f'<div style="opacity:.85">{html.escape(line)}</div>' for line in below]
    return "".join(parts)
