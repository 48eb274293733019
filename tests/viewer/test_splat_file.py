"""PLY files of anybody open as scenes; what is no such file ends with a sentence."""

from pathlib import Path

import numpy as np
import pytest
import torch

from splat_scenes import random_splats
from thermosplat.datasets.placement import WORLD, Placement
from thermosplat.errors import UserError
from thermosplat.export.formats.ply import write_splats
from thermosplat.export.scene import spectrum_splats
from thermosplat.export.splats import in_world
from thermosplat.viewer.layers import Layer, LayerRenderer, available_layers
from thermosplat.viewer.splat_file import open_splats
from toy_scene import toy_capture, toy_config, toy_model
from viewed_toy import viewed_toy


def exported(path: Path, *, compact: bool = False) -> torch.Tensor:
    """An exported toy scene that has no decoders; its own render from a view."""
    model = toy_model(toy_config(gaussian_sets="separate", feature_dim=0), toy_capture())
    write_splats(path, spectrum_splats(model, "rgb", toy_capture().scales), compact=compact)
    scene = viewed_toy()
    start = scene.start()
    with torch.no_grad():
        return model.render({"rgb": scene.view(start.viewmat, start.fov_y, 48, 36)}, sh_degree=1).images["rgb"]


@pytest.mark.parametrize("compact", [False, True])
def test_an_export_looks_as_its_scene(compact: bool, tmp_path: Path) -> None:
    """The file's render is the model's, to the last digits; it has images, depth and opacity."""
    expected = exported(tmp_path / "a.ply", compact=compact)
    scene = open_splats(tmp_path / "a.ply", torch.device("cpu"))
    start = viewed_toy().start()
    layer = Layer("image", "rgb")
    image = LayerRenderer(scene).render([layer], scene.view(start.viewmat, start.fov_y, 48, 36))[layer]
    assert image.colors is not None
    np.testing.assert_allclose(image.colors, 255 * expected.clamp(0, 1).numpy(), atol=0.5 + 255e-5)
    assert {layer.kind for layer in available_layers(scene)} == {"image", "depth", "opacity"}
    assert scene.sh_degree == (1 if compact else 3)


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_a_file_in_other_units_looks_the_same(unit: float, tmp_path: Path) -> None:
    """The near plane follows the scene: a millimetre's scene is not black. Depths are the file's."""
    splats = random_splats(40, 1)
    where = Placement(unit=unit)
    write_splats(tmp_path / "a.ply", splats)
    write_splats(tmp_path / "b.ply", in_world(splats, where))
    looked = []
    for name, scale in (("a", 1.0), ("b", unit)):
        scene = open_splats(tmp_path / f"{name}.ply", torch.device("cpu"))
        viewmat = np.eye(4)
        viewmat[2, 3] = 4.0 * scale
        view = scene.view(scene.model.placement.viewmat_to_scene(viewmat), 50.0, 48, 36)
        layers = [Layer("image", "rgb"), Layer("depth", "rgb")]
        image, depth = (found for found in LayerRenderer(scene).render(layers, view).values())
        assert image.colors is not None
        assert depth.field is not None
        looked.append((image.colors.astype(int), depth.field / scale))
        assert (scene.model.placement == WORLD) == (scale >= 1.0)
    assert looked[0][0].max() > 50
    np.testing.assert_allclose(looked[1][0], looked[0][0], atol=2)
    np.testing.assert_allclose(looked[1][1], looked[0][1], rtol=1e-3)


def test_a_file_of_degree_4_opens(tmp_path: Path) -> None:
    """Its 24 higher coefficients come back in their order."""
    splats = random_splats(6, 4)
    write_splats(tmp_path / "a.ply", splats)
    scene = open_splats(tmp_path / "a.ply", torch.device("cpu"))
    assert scene.sh_degree == 4
    torch.testing.assert_close(scene.model.gaussians("rgb").shN.detach(), splats.shN)


def test_a_scene_without_photographs_begins_in_front_of_its_gaussians(tmp_path: Path) -> None:
    """From the first view something is seen."""
    exported(tmp_path / "a.ply")
    scene = open_splats(tmp_path / "a.ply", torch.device("cpu"))
    start = scene.start()
    layer = Layer("opacity", "rgb")
    image = LayerRenderer(scene).render([layer], scene.view(start.viewmat, start.fov_y, 48, 36))[layer]
    assert image.field is not None
    assert image.field.mean() > 0.02
    assert scene.frame_spacing > 0


def test_broken_gaussians_are_left_out(tmp_path: Path) -> None:
    """A NaN in one vertex costs that vertex."""
    path = tmp_path / "a.ply"
    exported(path)
    whole = len(open_splats(path, torch.device("cpu")).model.gaussians("rgb"))
    content = bytearray(path.read_bytes())
    start = content.index(b"end_header\n") + len(b"end_header\n")
    content[start : start + 4] = np.float32(np.nan).tobytes()
    path.write_bytes(content)
    assert len(open_splats(path, torch.device("cpu")).model.gaussians("rgb")) == whole - 1


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda b: b"PK" + b, "not a PLY"),
        (lambda b: b[:-7], "cut off"),
        (lambda b: b.replace(b"element vertex ", b"element vertex 99999999999"), "cut off"),
        (lambda b: b.replace(b"opacity", b"0pacity"), "lacks the property opacity"),
        (lambda b: b.replace(b"property float nx", b"property float ny", 1), "twice"),
        (lambda b: b.replace(b"f_rest_44", b"f_rest_99"), "SH coefficients"),
        (lambda b: b.replace(b"binary_little_endian", b"ascii"), "not a binary PLY"),
        (lambda b: b.replace(b"property float x", b"property list uchar int x", 1), "lists or unknown types"),
        (lambda b: b.replace(b"end_header", b"x" * 70_000 + b"\nend_header"), "not a PLY"),
    ],
)
def test_what_is_no_splat_file_is_told(damage, said: str, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    """One sentence that names the file."""
    path = tmp_path / "a.ply"
    exported(path)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(UserError, match=said) as raised:
        open_splats(path, torch.device("cpu"))
    assert str(path) in raised.value.message
    with pytest.raises(UserError, match="Cannot read"):
        open_splats(tmp_path / "none.ply", torch.device("cpu"))
