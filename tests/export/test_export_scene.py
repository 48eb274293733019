"""What an exported scene looks like: colours and opacities of each spectrum."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from thermosplat.errors import UserError
from thermosplat.export.export_frame import ExportFrame
from thermosplat.export.scene import scene_splats, spectrum_splats, write_scene
from thermosplat.export.splats import WrittenSplats
from thermosplat.scene.decoder import with_fourier_features
from thermosplat.scene.gaussians import SH_C0
from thermosplat.scene.model import SceneModel
from thermosplat.thermal.radiometry import FLIR_IRON, PixelScale
from toy_scene import toy_capture, toy_config, toy_model


def exported(
    model: SceneModel, folder: Path, scales: dict[str, PixelScale], spectra: list[str] | None = None
) -> dict[str, WrittenSplats]:
    """What is written of a model, in the frame of its capture."""
    return write_scene(scene_splats(model, scales, spectra), folder, frame=ExportFrame(model.placement))


def constant_color(sh0: torch.Tensor) -> torch.Tensor:
    return 0.5 + SH_C0 * sh0[:, 0]


def test_hybrid_rgb_adds_the_decoded_color() -> None:
    """RGB is the SH colour plus each Gaussian's own decoded features; higher degrees and opacity stay."""
    capture = toy_capture()
    model = toy_model(toy_config(), capture)
    gaussians = model.gaussians("shared")
    splats = spectrum_splats(model, "rgb", capture.scales)
    expected = constant_color(gaussians.sh0) + model.formations.decoder.image("rgb", gaussians.features)
    torch.testing.assert_close(constant_color(splats.sh0), expected)
    torch.testing.assert_close(splats.shN, gaussians.shN)
    torch.testing.assert_close(splats.logit_opacities, gaussians.logit_opacities)
    assert not splats.sh0.requires_grad


def test_decoded_rgb_alone_replaces_the_sh_color() -> None:
    """Without the hybrid sum the colour is the decoded one, the same from everywhere."""
    capture = toy_capture()
    model = toy_model(toy_config(decoder={"hybrid": False}), capture)
    splats = spectrum_splats(model, "rgb", capture.scales)
    torch.testing.assert_close(
        constant_color(splats.sh0), model.formations.decoder.image("rgb", model.gaussians("shared").features)
    )
    assert not splats.shN.any()


@pytest.mark.parametrize("kind", ["color", "scalar"])
def test_thermal_is_decoded_at_the_thermal_opacity(kind: str) -> None:
    """Thermal colours are decoded features, a scalar through the palette; the opacity is α_t, even if it saturates."""
    capture = toy_capture(thermal_kind=kind)
    model = toy_model(toy_config(), capture)
    gaussians = model.gaussians("shared")
    with torch.no_grad():
        gaussians.logit_opacities[0] = 40.0
    splats = spectrum_splats(model, "thermal", capture.scales)
    decoded = model.formations.decoder.image("thermal", gaussians.features).detach()
    if kind == "scalar":
        decoded = torch.as_tensor(FLIR_IRON.to_color(decoded[:, 0].numpy())).float()
    torch.testing.assert_close(constant_color(splats.sh0), decoded)
    torch.testing.assert_close(torch.sigmoid(splats.logit_opacities), gaussians.opacities_in("thermal"))
    assert torch.isfinite(splats.logit_opacities).all()


def test_decoders_see_waves_of_each_gaussians_features() -> None:
    """What they were trained with, they are given for a splat's colour, too."""
    capture = toy_capture()
    model = toy_model(toy_config(decoder={"fourier_frequency": 3.0}), capture)
    inputs = with_fourier_features(model.gaussians("shared").features, 3.0)
    splats = spectrum_splats(model, "thermal", capture.scales)
    torch.testing.assert_close(constant_color(splats.sh0), model.formations.decoder.image("thermal", inputs).detach())


def test_separate_sets_export_their_own_harmonics() -> None:
    """In the 3DGS configuration each spectrum is its own set, exactly as it is rendered."""
    capture = toy_capture()
    model = toy_model(toy_config(gaussian_sets="separate", feature_dim=0), capture)
    for name in ("rgb", "thermal"):
        splats, gaussians = spectrum_splats(model, name, capture.scales), model.gaussians(name)
        torch.testing.assert_close(splats.sh0, gaussians.sh0)
        torch.testing.assert_close(splats.shN, gaussians.shN)
        torch.testing.assert_close(splats.logit_opacities, gaussians.logit_opacities)


def test_files_state_what_thermal_colors_mean(tmp_path: Path) -> None:
    """Both files are written; the thermal header has the palette and the temperatures of its ends."""
    plyfile = pytest.importorskip("plyfile", reason='plyfile is not installed (pip install ".[test]")')
    capture = toy_capture(thermal_kind="scalar")
    model = toy_model(toy_config(), capture)
    written = exported(model, tmp_path / "ply", capture.scales)
    assert {path.name for path in (tmp_path / "ply").iterdir()} == {"splat_rgb.ply", "splat_thermal.ply"}
    rgb, thermal = (plyfile.PlyData.read(str(written[name].path)) for name in ("rgb", "thermal"))
    assert thermal["vertex"].count == written["thermal"].num_gaussians > 0
    assert "thermal_range 10 30 celsius" in thermal.comments
    palette = next(comment for comment in thermal.comments if comment.startswith("thermal_palette"))
    assert palette.split()[-1] == "#fefefe"
    assert "#000000" in palette
    assert not any("thermal" in comment for comment in rgb.comments)
    assert any("approximate" in comment for comment in rgb.comments)


@pytest.mark.parametrize("sets", [{}, {"gaussian_sets": "separate", "feature_dim": 0}])
def test_splats_have_tensors_of_their_own(sets: dict[str, Any]) -> None:
    """None is a parameter of the model: files are written while another thread renders it (``meanwhile``)."""
    capture = toy_capture()
    model = toy_model(toy_config(**sets), capture)
    for name in ("rgb", "thermal"):
        splats = spectrum_splats(model, name, capture.scales)
        assert not any(tensor.requires_grad for tensor in vars(splats).values())


def test_unmodelled_spectrum_is_an_error(tmp_path: Path) -> None:
    """Asking for the splats of a spectrum that was not trained says so; by default only the trained one is written."""
    capture = toy_capture(thermal=False)
    model = toy_model(toy_config(without=("thermal",)), capture)
    with pytest.raises(UserError, match="trained without thermal images"):
        exported(model, tmp_path, capture.scales, ["thermal"])
    assert list(exported(model, tmp_path, capture.scales)) == ["rgb"]


def test_unknown_temperatures_are_said_to_be_unknown(tmp_path: Path) -> None:
    """Without degrees the header does not invent any."""
    capture = toy_capture()
    model = toy_model(toy_config(), capture)
    scales = {**capture.scales, "thermal": PixelScale("color", FLIR_IRON, None, "celsius")}
    written = exported(model, tmp_path, scales)
    header = written["thermal"].path.read_bytes().split(b"end_header")[0]
    assert b"comment thermal_range unknown\n" in header
    assert np.frombuffer(written["thermal"].path.read_bytes().split(b"end_header\n", 1)[1], "<f4").size % 62 == 0


def test_a_third_spectrum_has_a_file_of_its_own(tmp_path: Path) -> None:
    """Near infrared goes through its palette, grey, at its own opacity; the header says what black and white mean."""
    capture = toy_capture(others=("nir",))
    model = toy_model(toy_config(spectra={"nir": {"opacity": "offset"}}), capture)
    splats = spectrum_splats(model, "nir", capture.scales)
    gaussians = model.gaussians("shared")
    torch.testing.assert_close(splats.logit_opacities, gaussians.logits_in("nir"))
    decoded = model.formations.decoder.image("nir", gaussians.features).detach()
    torch.testing.assert_close(constant_color(splats.sh0), decoded.expand(-1, 3))
    written = exported(model, tmp_path, capture.scales)
    assert list(written) == ["rgb", "thermal", "nir"]
    header = written["nir"].path.read_bytes().split(b"end_header")[0]
    assert b"comment nir_range 0 1 reflectance\n" in header
