"""The renderers that are compared: each takes a case's tensors and returns its images."""

import sys
from collections.abc import Callable, Collection
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from peers.peer import NEAR_PLANE, Peer, Rendered, Renderer, Tensors
from peers.torch_renderer import torch_peer

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "fixtures"))
import gsplat_reference

PEERS = ("gsplat", "gswarp", "torch", "callable", "graph", "eager")
"""Whom thermosplat is compared with unless others are asked for; "callable" is itself made a function by
``torch.cuda.make_graphed_callables``, "graph" itself in one CUDA graph, "eager" itself with
``thermosplat.rasterizer.replay`` switched off, "deterministic" itself with that option."""

OURS = "thermosplat"
CALLABLE = "thermosplat, graphed callable"
GRAPH = "thermosplat in a graph"
EAGER = "thermosplat, eager"
ALL_OURS = (OURS, CALLABLE, GRAPH, EAGER)
"""Ways to call thermosplat that give the same and are each compared with the peers."""

WARM_UP_OF_REPLAYS = 10
"""Calls of each kind, after which those that are replayed at all are replayed."""

Rasterization = Callable[..., tuple[Tensor, Tensor, dict]]


def _camera(t: Tensors, width: int, height: int) -> dict[str, Any]:
    return {"viewmats": t["viewmats"], "Ks": t["Ks"], "width": width, "height": height}


def thermosplat_renderer(near_plane: float = NEAR_PLANE, deterministic: bool = False) -> Renderer:
    """This project's public functions."""
    from thermosplat import rasterization, rasterization_rgbt

    def renderer(case: str, t: Tensors, width: int, height: int) -> Callable[[], Rendered]:
        geometry = (t["means"], t["quats"], t["scales"], t["opacities"])
        camera = _camera(t, width, height) | {"near_plane": near_plane, "deterministic": deterministic}

        def single() -> Rendered:
            colors = {"colors": t["sh"], "sh_degree": 3} if case == "rgb" else {"colors": t["features"]}
            image, alphas, info = rasterization(*geometry, **colors, **camera, packed=False)
            return Rendered([image, alphas], [info])

        def both() -> Rendered:
            result = rasterization_rgbt(
                *geometry, t["thermal_opacities"], t["sh"], t["features"], **camera, sh_degree=3
            )
            images = [result.render_colors, result.render_features, result.render_alphas]
            return Rendered([*images, result.render_thermal_features, result.render_thermal_alphas], [result.info])

        return both if case == "rgbt" else single

    return renderer


def thermosplat_peer(near_plane: float = NEAR_PLANE, deterministic: bool = False) -> Peer:
    """This project as its users call it: on CUDA calls that come again are replayed."""
    from thermosplat import __version__
    from thermosplat.rasterizer import replay

    of_case = thermosplat_renderer(near_plane, deterministic)

    def renderer(case: str, t: Tensors, width: int, height: int) -> Callable[[], Rendered]:
        render = of_case(case, t, width, height)
        for _ in range(WARM_UP_OF_REPLAYS if t["means"].is_cuda else 0):
            images = render().images
            if t["means"].requires_grad:
                torch.autograd.grad([image.sum() for image in images], t["means"])
            with torch.no_grad():
                render()
        return render

    name, suffix = ("deterministic", ", deterministic=True") if deterministic else (OURS, "")
    description = f"thermosplat {__version__}, Warp kernels{suffix}"
    return Peer(name, description, renderer, release=replay.clear)


def graph_peer() -> Peer:
    """thermosplat again, captured in a CUDA graph."""
    ours = thermosplat_peer()
    description = f"{ours.description} replayed from a CUDA graph"
    return Peer(GRAPH, description, thermosplat_renderer(), captured="call")


def callable_peer() -> Peer:
    """thermosplat again, called as any function of torch's, whose two passes are CUDA graphs."""
    ours = thermosplat_peer()
    description = f"{ours.description} under torch.cuda.make_graphed_callables"
    return Peer(CALLABLE, description, thermosplat_renderer(), captured="function")


def eager_peer() -> Peer:
    """thermosplat again, every call launched kernel by kernel."""
    from thermosplat.rasterizer import replay

    of_case = thermosplat_renderer()

    def renderer(case: str, t: Tensors, width: int, height: int) -> Callable[[], Rendered]:
        plain = of_case(case, t, width, height)

        def render() -> Rendered:
            replay.enable(False)
            try:
                return plain()
            finally:
                replay.enable()

        return render

    return Peer(EAGER, f"{thermosplat_peer().description}, without replays", renderer)


def float64_renderer(near_plane: float = NEAR_PLANE) -> Renderer:
    """thermosplat's kernels for float64 tensors, as the truth; the frame at two opacities as two plain renderings.

    At most 8 channels are blended at a time, so that two compiled kernels do for all cases.
    """
    from thermosplat import rasterization

    def renderer(case: str, t: Tensors, width: int, height: int) -> Callable[[], Rendered]:
        shape = (t["means"], t["quats"], t["scales"])
        options = {"near_plane": near_plane, "channel_chunk": 8} | _camera(t, width, height)

        def render() -> Rendered:
            images = []
            if "sh" in t:
                images += rasterization(*shape, t["opacities"], t["sh"], sh_degree=3, **options)[:2]
            if "features" in t:
                features, alphas, _ = rasterization(*shape, t["opacities"], t["features"], **options)
                images = [features, alphas] if not images else [images[0], features, images[1]]
            if "thermal_opacities" in t:
                images += rasterization(*shape, t["thermal_opacities"], t["features"], **options)[:2]
            return Rendered(images, [])

        return render

    return renderer


def gsplat_renderer(rasterization: Rasterization, spherical_harmonics: Callable, **options: bool) -> Renderer:
    """gsplat's calls; the RGB + thermal frame is two of them, the first on SH colours joined with the features."""

    def renderer(case: str, t: Tensors, width: int, height: int) -> Callable[[], Rendered]:
        shape = (t["means"], t["quats"], t["scales"])
        camera = _camera(t, width, height)

        def single() -> Rendered:
            colors = {"colors": t["sh"], "sh_degree": 3} if case == "rgb" else {"colors": t["features"]}
            image, alphas, info = rasterization(*shape, t["opacities"], **colors, **camera, **options)
            return Rendered([image, alphas], [info])

        def both() -> Rendered:
            position = torch.linalg.inv(t["viewmats"])[0, :3, 3]
            rgb = (spherical_harmonics(3, t["means"] - position, t["sh"]) + 0.5).clamp(min=0.0)
            colors = torch.cat([rgb, t["features"]], -1)
            image, alphas, info = rasterization(*shape, t["opacities"], colors, **camera, **options)
            thermal, thermal_alphas, thermal_info = rasterization(
                *shape, t["thermal_opacities"], t["features"], **camera, **options
            )
            # split, whose gradient is one copy, where slices would each fill an image with zeros
            return Rendered([*image.split([3, 8], -1), alphas, thermal, thermal_alphas], [info, thermal_info])

        return both if case == "rgbt" else single

    return renderer


def cpu_peers(names: Collection[str]) -> list[Peer]:
    """thermosplat and, of those named, a plain torch renderer and, where it can be imported, gsplat's torch reference.

    Args:
        names: "torch", "gsplat".
    """
    peers = [thermosplat_peer()]
    if "torch" in names:
        peers.append(torch_peer())
    if "gsplat" not in names:
        return peers
    try:
        rasterization = gsplat_reference.install()
        from gsplat import rendering
    except ImportError as error:
        print(f"gsplat's torch reference is not importable ({error}); it is left out")
        return peers
    renderer = gsplat_renderer(rasterization, rendering.spherical_harmonics)
    description = f"gsplat {version('gsplat')}, _rasterization on the CPU"
    return [*peers, Peer("gsplat torch reference", description, renderer)]
