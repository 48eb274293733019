"""PLY files of anybody open as scenes; what is no such file ends with a sentence."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from splat_scenes import random_splats
from thermosplat.datasets.placement import WORLD, Placement
from thermosplat.errors import UserError
from thermosplat.export.formats.compressed_ply import write_compressed_ply
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
    scene, notes = open_splats(tmp_path / "a.ply", torch.device("cpu"))
    assert notes == []
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
        scene = open_splats(tmp_path / f"{name}.ply", torch.device("cpu"))[0]
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
    scene, notes = open_splats(tmp_path / "a.ply", torch.device("cpu"))
    assert notes == []
    assert scene.sh_degree == 4
    torch.testing.assert_close(scene.model.gaussians("rgb").shN.detach(), splats.shN)


def test_a_scene_without_photographs_begins_in_front_of_its_gaussians(tmp_path: Path) -> None:
    """From the first view something is seen."""
    exported(tmp_path / "a.ply")
    scene, notes = open_splats(tmp_path / "a.ply", torch.device("cpu"))
    assert notes == []
    start = scene.start()
    layer = Layer("opacity", "rgb")
    image = LayerRenderer(scene).render([layer], scene.view(start.viewmat, start.fov_y, 48, 36))[layer]
    assert image.field is not None
    assert image.field.mean() > 0.02
    assert scene.frame_spacing > 0


def rows_of(path: Path) -> np.ndarray:
    """The exported toy scene's vertices, by name."""
    exported(path)
    header, _, content = path.read_bytes().partition(b"end_header\n")
    names = [line.split()[-1].decode() for line in header.splitlines() if line.startswith(b"property")]
    return np.frombuffer(content, np.dtype([(name, "<f4") for name in names])).copy()


def written(path: Path, rows: np.ndarray, kind: str = "float") -> Path:
    properties = "".join(f"property {kind} {name}\n" for name in rows.dtype.names or ())
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
    path.write_bytes(header.encode() + rows.tobytes())
    return path


@pytest.mark.parametrize(
    ("name", "value", "is_shown"),
    [
        ("opacity", np.inf, True),
        ("opacity", -np.inf, True),
        ("scale_1", -np.inf, True),
        ("scale_2", -1e30, True),
        ("opacity", np.nan, False),
        ("scale_0", np.inf, False),
        ("scale_0", 200.0, False),
        ("scale_0", np.nan, False),
        ("x", np.inf, False),
        ("y", np.nan, False),
        ("f_dc_1", -np.inf, False),
        ("f_rest_7", np.nan, False),
        ("rot_0", np.inf, False),
    ],
)
def test_what_has_no_value_is_left_out_with_a_note(name: str, value: float, is_shown: bool, tmp_path: Path) -> None:
    """An infinite logit is an opacity of 1 or 0, and the logarithm of 0 is -infinity: those are Gaussians."""
    rows = rows_of(tmp_path / "a.ply")
    rows[name][:5] = value
    scene, notes = open_splats(written(tmp_path / "b.ply", rows), torch.device("cpu"))
    gaussians = scene.model.gaussians("rgb")
    assert len(gaussians) == len(rows) - (0 if is_shown else 5)
    assert [f"5 of {len(rows)} Gaussians are not shown" in note for note in notes] == ([] if is_shown else [True])
    start = scene.start()
    layers = available_layers(scene)
    images = LayerRenderer(scene).render(layers, scene.view(start.viewmat, start.fov_y, 24, 18))
    opacity = images[Layer("opacity", "rgb")].field
    assert opacity is not None
    assert np.isfinite(opacity).all()
    assert opacity.max() > 0.1
    if name == "opacity" and is_shown:
        assert torch.sigmoid(gaussians.logit_opacities[:5]).tolist() == pytest.approx([float(value > 0)] * 5, abs=1e-12)


def test_a_rotation_has_a_length(tmp_path: Path) -> None:
    """One of length 0 is none; a long one is as good as a short one."""
    rows = rows_of(tmp_path / "a.ply")
    for index in range(4):
        rows[f"rot_{index}"][0] = 0.0
        rows[f"rot_{index}"][1] *= 1e30
        rows[f"rot_{index}"][2] *= 1e-30
    scene, notes = open_splats(written(tmp_path / "b.ply", rows), torch.device("cpu"))
    plain, _ = open_splats(tmp_path / "a.ply", torch.device("cpu"))
    assert [note.startswith("1 of") for note in notes] == [True]
    torch.testing.assert_close(scene.model.gaussians("rgb").quats, plain.model.gaussians("rgb").quats[1:])


def test_large_float64_values_are_no_float32_ones(tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    """They are left out, without a warning of numpy's."""
    rows = rows_of(tmp_path / "a.ply")
    large = rows.astype([(name, "<f8") for name in rows.dtype.names or ()])
    large["z"][0] = 1e300
    scene, notes = open_splats(written(tmp_path / "b.ply", large, "double"), torch.device("cpu"))
    assert len(scene.model.gaussians("rgb")) == len(rows) - 1
    assert len(notes) == 1
    assert not recwarn.list


def test_our_compressed_file_is_told(tmp_path: Path) -> None:
    """What it is, and how to get one that can be read."""
    write_compressed_ply(tmp_path / "a.compressed.ply", random_splats(300, 1))
    with pytest.raises(UserError, match=r"is a compressed PLY, .*thermosplat-export RUN --format ply"):
        open_splats(tmp_path / "a.compressed.ply", torch.device("cpu"))


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    """It is no file."""
    os.mkfifo(tmp_path / "a.ply")
    for path in (tmp_path / "a.ply", tmp_path):
        with pytest.raises(UserError, match="is no file"):
            open_splats(path, torch.device("cpu"))


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda b: b"PK" + b, "is no PLY file"),
        (lambda b: b[:-7], "cut off"),
        (lambda b: b.replace(b"element vertex ", b"element vertex 99999999999"), "cut off"),
        (lambda b: b.replace(b"opacity", b"0pacity"), "lack opacity"),
        (lambda b: b.replace(b"property float nx", b"property float ny", 1), "no PLY header"),
        (lambda b: b.replace(b"f_rest_44", b"f_rest_99"), "SH coefficients"),
        (lambda b: b.replace(b"binary_little_endian", b"ascii"), "it is a text"),
        (lambda b: b.replace(b"property float x", b"property list uchar int x", 1), "which is not known"),
        (lambda b: b.replace(b"end_header", b"x" * 70_000 + b"\nend_header"), "no end"),
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
