"""The renderers that are compared: each takes a case's tensors and returns its images."""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import torch
from torch import Tensor

Images = list[Tensor]
Rasterization = Callable[..., tuple[Tensor, Tensor, dict]]


@dataclass(frozen=True)
class Peer:
    """A renderer by name.

    Attributes:
        name: as printed.
        description: version and kind.
        renderer: (case, tensors, width, height) -> a call that renders and returns the images.
    """

    name: str
    description: str
    renderer: Callable[[str, dict[str, Tensor], int, int], Callable[[], Images]]


def _camera(t: dict[str, Tensor], width: int, height: int) -> dict:
    return {"viewmats": t["viewmats"], "Ks": t["Ks"], "width": width, "height": height}


def thermosplat_peer() -> Peer:
    """This project."""
    from thermosplat import __version__, rasterization, rasterization_rgbt

    def renderer(case: str, t: dict[str, Tensor], width: int, height: int) -> Callable[[], Images]:
        geometry = (t["means"], t["quats"], t["scales"], t["opacities"])
        camera = _camera(t, width, height)

        def single() -> Images:
            colors = {"colors": t["sh"], "sh_degree": 3} if case == "rgb" else {"colors": t["features"]}
            image, alphas, _ = rasterization(*geometry, **colors, **camera, packed=False)
            return [image, alphas]

        def both() -> Images:
            result = rasterization_rgbt(
                *geometry, t["thermal_opacities"], t["sh"], t["features"], **camera, sh_degree=3
            )
            return [
                torch.cat([result.render_colors, result.render_features], -1),
                result.render_alphas,
                result.render_thermal_features,
                result.render_thermal_alphas,
            ]

        return both if case == "rgbt" else single

    return Peer("thermosplat", f"thermosplat {__version__}, Warp kernels", renderer)


def _gsplat_renderer(rasterization: Rasterization, spherical_harmonics: Callable, **options: bool) -> Callable:
    """gsplat's calls; the RGB + thermal frame is two of them, the first on SH colours joined with the features."""

    def renderer(case: str, t: dict[str, Tensor], width: int, height: int) -> Callable[[], Images]:
        shape = (t["means"], t["quats"], t["scales"])
        camera = _camera(t, width, height)

        def single() -> Images:
            colors = {"colors": t["sh"], "sh_degree": 3} if case == "rgb" else {"colors": t["features"]}
            image, alphas, _ = rasterization(*shape, t["opacities"], **colors, **camera, **options)
            return [image, alphas]

        def both() -> Images:
            position = torch.linalg.inv(t["viewmats"])[0, :3, 3]
            rgb = (spherical_harmonics(3, t["means"] - position, t["sh"]) + 0.5).clamp(min=0.0)
            colors = torch.cat([rgb, t["features"]], -1)
            image, alphas, _ = rasterization(*shape, t["opacities"], colors, **camera, **options)
            thermal, thermal_alphas, _ = rasterization(
                *shape, t["thermal_opacities"], t["features"], **camera, **options
            )
            return [image, alphas, thermal, thermal_alphas]

        return both if case == "rgbt" else single

    return renderer


def cuda_peers(alone: bool) -> list[Peer]:
    """thermosplat and, where it can be imported, gsplat's CUDA kernels."""
    peers = [thermosplat_peer()]
    if alone:
        return peers
    try:
        import gsplat

        renderer = _gsplat_renderer(gsplat.rasterization, gsplat.spherical_harmonics, packed=False)
    except ImportError as error:
        print(f"gsplat is not importable ({error}); timing thermosplat alone")
        return peers
    return [*peers, Peer("gsplat", f"gsplat {version('gsplat')}, CUDA kernels", renderer)]


def cpu_peers(oracle: Path, alone: bool) -> list[Peer]:
    """thermosplat and, where gsplat and its CPU oracle are at hand, gsplat's torch reference."""
    peers = [thermosplat_peer()]
    if alone:
        return peers
    sys.path.insert(0, str(oracle))
    try:
        import gsplat_oracle

        rasterization = gsplat_oracle.install()
        from gsplat import rendering
    except ImportError as error:
        print(f"gsplat's torch reference is not importable ({error}); timing thermosplat alone")
        return peers
    renderer = _gsplat_renderer(rasterization, rendering.spherical_harmonics)
    return [*peers, Peer("gsplat torch reference", f"gsplat {version('gsplat')}, _rasterization on the CPU", renderer)]
