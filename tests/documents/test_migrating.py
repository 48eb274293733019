"""The table of gsplat's arguments: complete for both versions, and true of our signature."""

import inspect
import re

import pytest

from repository_documents import REPOSITORY
from thermosplat import UserError, rasterization
from thermosplat.rasterizer.arguments import refuse_unsupported

MAIN = """means quats scales opacities colors viewmats Ks width height near_plane far_plane radius_clip eps2d sh_degree
packed tile_size backgrounds render_mode sparse_grad absgrad rasterize_mode channel_chunk distributed
camera_model segmented covars with_ut with_eval3d return_normals global_z_order rays radial_coeffs
tangential_coeffs thin_prism_coeffs ftheta_coeffs lidar_coeffs external_distortion_coeffs rolling_shutter
viewmats_rs ut_params extra_signals extra_signals_sh_degree renderer_config"""
"""Arguments of ``gsplat.rasterization`` at 90d7b4b3, in order."""


def table() -> dict[str, list[str]]:
    """Rows of the table by argument: in 1.5.3, in main, here."""
    text = (REPOSITORY / "docs" / "migrating.md").read_text(encoding="utf-8")
    part = text.split("### Every argument of gsplat")[1].split("###")[0]
    rows = re.findall(r"^\| `(\w+)` \| (.*) \|$", part, flags=re.MULTILINE)
    return {name: [cell.strip() for cell in cells.split(" | ")] for name, cells in rows}


def test_every_argument_of_the_main_branch_is_there() -> None:
    """In its order, behind them our own; nothing else."""
    rows, own = table(), list(inspect.signature(rasterization).parameters)
    theirs = MAIN.split()
    assert list(rows)[: len(theirs)] == theirs
    assert [rows[name][1] for name in theirs] == ["yes"] * len(theirs)
    assert set(rows) == set(own) | set(theirs)
    assert all(rows[name][:2] == ["-", "-"] for name in set(own) - set(theirs))


def test_every_argument_of_the_release_is_marked() -> None:
    """Those of the installed gsplat 1.5.3, and no others."""
    gsplat = pytest.importorskip("gsplat", reason="gsplat 1.5.3 is not installed")
    released = list(inspect.signature(gsplat.rasterization).parameters)
    assert [name for name, cells in table().items() if cells[0] == "yes"] == [
        name for name in MAIN.split() if name in released
    ]
    assert set(released) <= set(table())


def test_what_the_table_says_of_us_is_so() -> None:
    """All arguments are taken; those that are called keyword only are; those that raise do."""
    own = inspect.signature(rasterization).parameters
    for name, (_, _, here) in table().items():
        assert name in own
        assert ("keyword only" in here or "raises" in here) == (own[name].kind is inspect.Parameter.KEYWORD_ONLY), name
        if "raises" in here:
            with pytest.raises(UserError, match=f"does not support {name}"):
                refuse_unsupported(**{name: object()})
    refused = [name for name, cells in table().items() if "raises" in cells[2]]
    source = inspect.getsource(inspect.unwrap(rasterization)).split("refuse_unsupported(")[1].split(")")[0]
    assert re.findall(r"(\w+)=\1", source) == refused
