"""What ThermoSplat's paper (Su et al., arXiv 2601.15897) reports on RGBT-Scenes: tables 1 and 2.

Means over its ten scenes, and per scene the PSNR that its table gives for its own method. LPIPS stands beside ours for
completeness: the paper's rows mix backbones and input scalings (docs/method.md).
"""

from typing import NamedTuple

from thermosplat.method_matrix.published_scenes import COLLECTIONS, plain_name
from thermosplat.spectra import CELSIUS, MAE

SCENES = tuple(COLLECTIONS["rgbt-scenes"].scenes)
"""The ten scenes of RGBT-Scenes in the paper's order."""


METHODS = (
    *("3dgs", "thermalgaussian_mftg", "thermalgaussian_msmg", "thermalgaussian_ommg", "ms_splatting", "mmone"),
    *("mlp_based", "no_geometric_decoupling", "no_hybrid_rgb", "no_thermal_feature_loss", "no_rgb_feature_loss"),
    "thermosplat",
)
"""Presets in the order of the paper's tables."""

FULL_METHOD = "thermosplat"
"""The paper's own method, which its ablations are compared with."""


class PaperMeans(NamedTuple):
    """PSNR [dB], SSIM and LPIPS, means over the ten scenes."""

    psnr: float
    ssim: float
    lpips: float


MEANS: dict[str, dict[str, PaperMeans]] = {
    "3dgs": {"rgb": PaperMeans(23.41, 0.826, 0.214), "thermal": PaperMeans(24.27, 0.861, 0.205)},
    # "ThermalGaussian" in the paper; which strategy it does not say, the numbers are close to those of OMMG
    "thermalgaussian_ommg": {"rgb": PaperMeans(24.44, 0.847, 0.203), "thermal": PaperMeans(25.64, 0.882, 0.170)},
    "ms_splatting": {"rgb": PaperMeans(24.41, 0.852, 0.168), "thermal": PaperMeans(25.61, 0.877, 0.114)},
    "mmone": {"rgb": PaperMeans(24.89, 0.854, 0.209), "thermal": PaperMeans(25.89, 0.890, 0.176)},
    "thermosplat": {"rgb": PaperMeans(25.23, 0.871, 0.153), "thermal": PaperMeans(26.08, 0.897, 0.101)},
    "mlp_based": {"rgb": PaperMeans(25.14, 0.869, 0.154), "thermal": PaperMeans(25.88, 0.895, 0.104)},
    "no_geometric_decoupling": {"rgb": PaperMeans(25.07, 0.868, 0.159), "thermal": PaperMeans(25.82, 0.892, 0.106)},
    "no_hybrid_rgb": {"rgb": PaperMeans(25.07, 0.867, 0.157), "thermal": PaperMeans(25.86, 0.893, 0.105)},
    "no_thermal_feature_loss": {"rgb": PaperMeans(24.98, 0.868, 0.155), "thermal": PaperMeans(25.77, 0.894, 0.107)},
    "no_rgb_feature_loss": {"rgb": PaperMeans(24.88, 0.858, 0.190), "thermal": PaperMeans(25.93, 0.897, 0.104)},
}
"""Means by preset and spectrum."""

_THERMOSPLAT_PSNR: dict[str, tuple[float, ...]] = {
    "rgb": (24.59, 22.12, 27.21, 28.96, 24.31, 24.20, 24.14, 25.98, 26.48, 24.31),
    "thermal": (25.99, 21.54, 22.95, 26.83, 26.25, 28.48, 27.45, 29.78, 27.00, 24.50),
}
SCENE_PSNR: dict[str, dict[str, dict[str, float]]] = {
    "thermosplat": {spectrum: dict(zip(SCENES, values, strict=True)) for spectrum, values in _THERMOSPLAT_PSNR.items()},
    "mmone": {"rgb": {"LandScape": 21.81}, "thermal": {"LandScape": 22.52}},
}
"""PSNR by preset, spectrum and scene, as far as it is at hand."""

THERMONERF_MAE = 1.5
"""Mean absolute error of ThermoNeRF over its ten scenes [°C]. Hassan et al., arXiv 2403.12154v1, abstract."""


def paper_scene(name: str) -> str | None:
    """The paper's scene of that name, whatever its capitals and underscores; None where it has none."""
    plain = plain_name(name)
    return next((scene for scene in SCENES if plain_name(scene) == plain), None)


def paper_value(method: str, spectrum: str, metric: str, scene: str) -> float | None:
    """The paper's number for one scene; None where it is not at hand."""
    known = paper_scene(scene)
    if metric != "psnr" or known is None:
        return None
    return SCENE_PSNR.get(method, {}).get(spectrum, {}).get(known)


def paper_mean(method: str, spectrum: str, metric: str, scenes: list[str]) -> float | None:
    """The paper's mean, if the scenes are its ten; None otherwise."""
    if {paper_scene(scene) for scene in scenes} != set(SCENES) or spectrum not in MEANS.get(method, {}):
        return None
    return getattr(MEANS[method][spectrum], metric, None)


def others_means(metric: str, scenes: list[str]) -> dict[str, float]:
    """What authors of methods that are not here report as their mean over these very scenes, by method."""
    names = {plain_name(scene) for scene in scenes}
    ten = {plain_name(scene) for scene in COLLECTIONS["thermoscenes"].scenes}
    return {"thermonerf": THERMONERF_MAE} if metric == f"{MAE}{CELSIUS}" and names == ten else {}
