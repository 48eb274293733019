"""What the words of a call ask for."""

from typing import Any, get_args

import numpy as np
import pytest

from thermosplat import UserError
from thermosplat.rasterizer.arguments import RenderMode
from thermosplat.rasterizer.render_options import render_options
from warp_kernels.constants import CHANNELS_MAX


def test_render_modes_say_what_is_blended() -> None:
    """Each of gsplat's words, by its letters."""
    shown = {
        mode: "".join(
            letter for letter, asked in zip("cdehw", render_options(mode, None, None, 32)[3:], strict=True) if asked
        )
        for mode in get_args(RenderMode)
    }
    assert shown == {
        "RGB": "c", "D": "d", "ED": "dew", "RGB+D": "cd", "RGB+ED": "cdew",
        "d": "hw", "Ed": "ehw", "RGB-d": "ch", "RGB-Ed": "cehw",
    }  # fmt: skip


def test_numbers_become_pythons() -> None:
    """A degree of NumPy's is a degree; a traversal never blends more channels than there is room for."""
    options = render_options("RGB", np.int64(3), None, np.int32(1000))  # type: ignore[arg-type]
    assert (type(options.sh_degree), options.sh_degree) == (int, 3)
    assert options.chunk == CHANNELS_MAX
    assert render_options("RGB", None, 0, 5).chunk == 5


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("rgb", None, None, 32), "render_mode must be one of"),
        (("RGB", True, None, 32), "sh_degree must be one of"),
        (("RGB", None, 7, 32), "extra_signals_sh_degree must be one of"),
        (("RGB", None, None, 0), "channel_chunk must be at least 1"),
        (("RGB", None, None, 32.0), "channel_chunk must be at least 1"),
    ],
)
def test_others_are_refused_every_time(arguments: tuple[Any, ...], message: str) -> None:
    """By name, also where an equal number of another kind was right before."""
    render_options("RGB", 1, 1, 32)
    for _ in range(2):
        with pytest.raises(UserError, match=message):
            render_options(*arguments)
