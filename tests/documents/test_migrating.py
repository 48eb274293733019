"""The tables of gsplat's arguments and names: complete for both versions, and true of what there is."""

import ast
import importlib
import inspect
import re
from pathlib import Path

import pytest

import thermosplat
from repository_documents import REPOSITORY
from thermosplat import UserError, rasterization
from thermosplat.gsplat_names import INSTEAD
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


def names_in_the_table() -> set[str]:
    """gsplat's names that the document has a row for."""
    text = (REPOSITORY / "docs" / "migrating.md").read_text(encoding="utf-8")
    part = text.split("### Every name of gsplat")[1].split("\nValues that differ")[0]
    return {
        name for row in re.findall(r"^\| (`.*?) \|", part, flags=re.MULTILINE) for name in re.findall(r"`(\w+)`", row)
    }


def test_every_name_of_gsplat_is_offered_or_answered() -> None:
    """Those of the installed 1.5.3, and 81 of both versions together, in the table and by the package."""
    gsplat = pytest.importorskip("gsplat", reason="gsplat 1.5.3 is not installed")
    tree = ast.parse(Path(gsplat.__file__).read_text(encoding="utf-8"))
    froms = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    released = {alias.asname or alias.name for node in froms for alias in node.names}
    offered = set(thermosplat.__all__) & (names_in_the_table() | {"__version__"})
    assert released <= offered | set(INSTEAD)
    assert names_in_the_table() | {"__version__"} == offered | set(INSTEAD)
    assert len(offered | set(INSTEAD)) == 81
    for name in re.findall(r"thermosplat\.[\w.]+", " ".join(INSTEAD.values())):
        module, _, last = name.rpartition(".")
        assert hasattr(importlib.import_module(module), last) or importlib.util.find_spec(name) is not None, name


@pytest.mark.parametrize("name", ["world_to_cam", "rasterization_2dgs", "MCMCStrategy", "has_3dgut"])
def test_a_name_that_there_is_not_says_what_there_is(name: str) -> None:
    """As an attribute and in an import; hasattr() and getattr() with a default do not fail."""
    message = f"thermosplat.{name} does not exist: {INSTEAD[name]}"
    with pytest.raises(AttributeError, match=re.escape(message)):
        getattr(thermosplat, name)
    with pytest.raises(ImportError, match=re.escape(message)):
        exec(f"from thermosplat import {name}")
    assert not hasattr(thermosplat, name)
    assert getattr(thermosplat, name, None) is None
