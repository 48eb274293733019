"""The page without a browser: what it may load, whose names it holds, how large it is."""

import base64
import gzip
import hashlib
import json
import re
from dataclasses import replace

import pytest
import torch

from page_scenes import HOSTILE, page_layers, page_scene, random_splats
from thermosplat.errors import UserError
from thermosplat.export.formats.splat_formats import check_degree
from thermosplat.export.page.packed_splats import packed
from thermosplat.export.page.written_page import page_of
from thermosplat.thermal.radiometry import FLIR_IRON


def test_the_policy_allows_the_pages_own_script_alone() -> None:
    """Nothing may be loaded, and the hashes are those of the one script and the one style that run."""
    page = page_of(page_scene(), page_layers(), FLIR_IRON)
    policy = re.search('Content-Security-Policy" content="([^"]*)"', page)[1]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    for kind, text in re.findall(r"<(script|style)>(.*?)</\1>", page, re.DOTALL):
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"{kind}-src 'sha256-{digest}'" in policy
    assert len(re.findall("<script>", page)) == 1
    assert not re.search(r"<[^>]*\b(src|href)=", page)


def test_names_of_strangers_end_no_element() -> None:
    """Titles, layers, views and marks may hold anything, and are read back as they are."""
    page = page_of(page_scene(), page_layers(), FLIR_IRON)
    assert HOSTILE not in page
    scene, marks = (
        json.loads(re.search(rf'id="{name}">(.*?)</script>', page, re.DOTALL)[1]) for name in ("scene", "marks")
    )
    assert scene["title"] == HOSTILE
    assert [layer["name"] for layer in scene["layers"]] == ["RGB", HOSTILE]
    assert marks[0]["text"] == HOSTILE


@pytest.mark.parametrize(("channels", "bytes_each"), [(3, 68), (1, 35)])
def test_splats_take_few_bytes(channels: int, bytes_each: int) -> None:
    """What is packed is as long as its description says, and what cannot be seen is left out."""
    splats = random_splats(700)
    splats.logit_opacities[:100] = -9.0
    described, content = packed(splats, channels)
    assert described["count"] == 600
    assert len(gzip.decompress(content)) <= 600 * bytes_each + 3 * 24 + 3 * 1024


def test_nothing_to_see() -> None:
    """A scene whose splats are all too faint makes no page."""
    splats = random_splats(5)
    splats.logit_opacities[:] = -9.0
    with pytest.raises(UserError, match="No Gaussian of this run can be seen"):
        packed(splats, 1)


def test_harmonics_of_degree_four_are_refused() -> None:
    """The page evaluates three degrees."""
    splats = random_splats(5)
    check_degree("html", "rgb", splats)
    four = replace(splats, shN=torch.ones(5, 24, 3))
    with pytest.raises(UserError, match="html holds spherical harmonics up to degree 3"):
        check_degree("html", "rgb", four)
