"""What the words and numbers of a call ask to be blended."""

from typing import NamedTuple

from thermosplat.errors import UserError
from thermosplat.rasterizer.arguments import RenderMode, check_choice, checked_choice, remembered
from thermosplat.rasterizer.checked_numbers import as_whole
from warp_kernels.constants import CHANNELS_MAX


class RenderOptions(NamedTuple):
    """Of one call of ``rasterization``."""

    sh_degree: int | None
    extra_signals_sh_degree: int | None
    chunk: int
    """Channels of one traversal."""
    colors: bool
    """Whether they are shown, as are those below."""
    depths: bool
    expected: bool
    """Depths are divided by the sum of their weights."""
    hits: bool
    """Depths are distances along rays."""
    weights: bool
    """Ones are blended, too."""


@remembered
def render_options(
    render_mode: RenderMode, sh_degree: int | None, extra_signals_sh_degree: int | None, channel_chunk: int
) -> RenderOptions:
    """Checks what a call asks for.

    Args:
        render_mode: As in ``rasterization``, as are those below.

    Raises:
        UserError: naming the argument, what is supported, and what was given.
    """
    check_choice("render_mode", render_mode)
    chunk = as_whole(channel_chunk)
    if type(chunk) is not int or chunk < 1:
        raise UserError(f"channel_chunk must be at least 1, and whole, got {chunk!r}.")
    expected = "E" in render_mode
    return RenderOptions(
        sh_degree=checked_choice("sh_degree", sh_degree),
        extra_signals_sh_degree=checked_choice("extra_signals_sh_degree", extra_signals_sh_degree),
        chunk=min(chunk, CHANNELS_MAX),
        colors="RGB" in render_mode,
        depths="D" in render_mode,
        expected=expected,
        hits=render_mode.endswith("d"),
        weights=expected or render_mode == "d",
    )
