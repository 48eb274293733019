"""Trained scenes are read back as they were written."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from scenes.trained_scene import distant_camera, read_ply, trained_scene
from thermosplat.config import TrainConfig
from thermosplat.config.files import to_dict
from thermosplat.export.formats.ply import PROPERTIES, write_splats
from thermosplat.export.splats import Splats
from thermosplat.runs.checkpoint_file import save_checkpoint
from thermosplat.scene.formations.scene_formations import Formations
from thermosplat.scene.gaussians import Gaussians
from thermosplat.scene.model import SceneModel
from thermosplat.spectra import ColorSpace, model_spectra
from thermosplat.thermal.radiometry import PixelScale


def parameters(count: int, sh_coefficients: int) -> dict[str, torch.Tensor]:
    """Random parameters of a set of Gaussians."""
    generator = torch.Generator().manual_seed(5)

    def random(*shape: int) -> torch.Tensor:
        return torch.randn(count, *shape, generator=generator)

    return {
        "means": random(3),
        "quats": torch.nn.functional.normalize(random(4), dim=-1),
        "log_scales": random(3) - 3,
        "logit_opacities": random(),
        "sh0": random(1, 3),
        "shN": random(sh_coefficients - 1, 3),
    }


def test_an_exported_ply_is_read_back(tmp_path: Path) -> None:
    """Means, scales, opacities and all SH coefficients survive."""
    splats = Splats(**parameters(12, 16))
    path = write_splats(tmp_path / "chair.ply", splats, ["a comment"]).path
    assert tuple(read_ply(path)) == PROPERTIES
    scene = trained_scene(path)
    assert scene.name == "trained chair"
    torch.testing.assert_close(scene.means, splats.means)
    torch.testing.assert_close(scene.scales, splats.log_scales.exp())
    torch.testing.assert_close(scene.opacities, splats.logit_opacities.sigmoid())
    torch.testing.assert_close(scene.quats, splats.quats)
    torch.testing.assert_close(scene.sh, torch.cat([splats.sh0, splats.shN], 1))


def test_another_ply_is_refused(tmp_path: Path) -> None:
    """Text files and files of other properties are not misread."""
    path = tmp_path / "mesh.ply"
    path.write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n")
    with pytest.raises(ValueError, match="not a binary little endian PLY"):
        read_ply(path)
    path.write_text("ply\nformat ascii 1.0\n")
    with pytest.raises(ValueError, match="its header does not end"):
        read_ply(path)


def test_a_checkpoint_is_read_with_features_and_thermal_opacities(tmp_path: Path) -> None:
    """Activated parameters of a run; where its capture is gone, it is seen from a distance, and that is said."""
    values = parameters(9, 4)
    values["features"] = torch.rand(9, 8)
    values["thermal_opacity_offsets"] = torch.ones(9)
    config = TrainConfig(data=str(tmp_path / "gone"), sh_degree=1)
    config = replace(config, model=replace(config.model, feature_dim=8))
    kinds: dict[str, ColorSpace] = {"rgb": "photograph", "thermal": "color"}
    formations = Formations(config.model, config.decoder, model_spectra(config.modelled, kinds))
    model = SceneModel(config.model, formations, {"shared": Gaussians(values)})
    state = {"step": 3, "config": to_dict(config), "sh_degree": 1, "model": vars(model.checkpoint_state())}
    path = tmp_path / "run" / "ckpts" / "step_000003.pt"
    scales = {name: PixelScale(kind).state_dict() for name, kind in kinds.items()}
    save_checkpoint(path, state | {"scales": scales, "training": {}})
    for given in (path, tmp_path / "run"):
        scene = trained_scene(given)
        assert scene.name == "trained run"
        torch.testing.assert_close(scene.thermal_opacities, (values["logit_opacities"] + 1).sigmoid())
        torch.testing.assert_close(scene.sh[:, :4], torch.cat([values["sh0"], values["shN"]], 1))
        assert not scene.sh[:, 4:].any()
        torch.testing.assert_close(scene.features(11)[:, 8:], values["features"][:, :3])
        torch.testing.assert_close(scene.viewmat, distant_camera(values["means"])[0])


def test_a_distant_camera_sees_the_gaussians() -> None:
    """Most of them project into the image, in front of the camera."""
    means = torch.randn(400, 3, generator=torch.Generator().manual_seed(1)) * 7 + torch.tensor([100.0, -40, 3])
    viewmat, K = distant_camera(means)
    seen = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    pixels = (seen @ K.T)[:, :2] / seen[:, 2:]
    inside = (seen[:, 2] > 0) & (pixels > 0).all(-1) & (pixels < 1).all(-1)
    assert inside.float().mean() > 0.6
