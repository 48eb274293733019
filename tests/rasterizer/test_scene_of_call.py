"""A projection without a blending: what ``rasterization`` makes first."""

import pytest
import torch

from gaussian_scenes import random_scene
from thermosplat.errors import UserError
from thermosplat.rasterizer import project, rasterization


def test_blended_it_is_rasterization() -> None:
    """The same projection, and the same image to the bit, of values and of spherical harmonics."""
    for sh_degree in (None, 2):
        scene = random_scene(n=12, width=20, height=14, sh_degree=sh_degree)
        scene = {name: value for name, value in scene.items() if name != "backgrounds"}
        image, alphas, info = rasterization(**scene, packed=False)
        colors = scene.pop("colors")
        degree = scene.pop("sh_degree", None)
        projected = project(**scene, drawn={"colors": (colors, degree)})
        visible = projected.projected.visible
        assert torch.equal(visible, info["visible"])
        assert torch.equal(projected.means2d[visible], info["means2d"][visible])
        blended = projected.blend(projected.features[0], False)
        assert torch.equal(blended.render, image)
        assert torch.equal(blended.alphas, alphas)


def test_what_is_wrong_is_named() -> None:
    """Under the name that was given to what is drawn."""
    scene = random_scene(n=5)
    given = {
        name: scene[name] for name in ("means", "quats", "scales", "opacities", "viewmats", "Ks", "width", "height")
    }
    with pytest.raises(UserError, match=r"^heat without sh_degree must have shape"):
        project(**given, drawn={"heat": (torch.zeros(4, 1), None)})
    with pytest.raises(UserError, match=r"^thermal_opacities must have shape"):
        project(**given, thermal_opacities=torch.zeros(4))
    assert project(**given).features == []
