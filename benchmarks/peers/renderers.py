"""The renderers that are compared: each takes a case's tensors and returns its images."""

import sys
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from measuring.agreement import SAME_CONVENTIONS, Tolerance

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "fixtures"))
import gsplat_reference

NEAR_PLANE = 0.01
"""gsplat's and thermosplat's default [world units]."""

CASES = ("rgb", "features8", "features11", "features32", "rgbt")
"""rgb: SH colour of degree 3. featuresN: N channels. rgbt: SH colour and 8 features at α, the 8 features at α_t."""

PEERS = ("gsplat", "gswarp", "torch", "callable", "graph")
"""Whom thermosplat is compared with unless others are asked for; "callable" is itself made a function by
``torch.cuda.make_graphed_callables``, "graph" itself in one CUDA graph, "deterministic" itself with that option."""

OURS = "thermosplat"
CALLABLE = "thermosplat, graphed callable"
GRAPH = "thermosplat in a graph"
ALL_OURS = (OURS, CALLABLE, GRAPH)
"""Ways to call thermosplat that give the same and are each compared with the peers."""

Tensors = dict[str, Tensor]
Rasterization = Callable[..., tuple[Tensor, Tensor, dict]]


class Rendered(NamedTuple):
    """What a renderer made of a case.

    Attributes:
        images: [1, H, W, X] colours and alphas, the same for every renderer of a case.
        infos: one dictionary of gsplat's kind a rasterization; none where the renderer has no such thing.
    """

    images: list[Tensor]
    infos: list[Mapping[str, Any]]

    @property
    def intersections(self) -> int | None:
        """(Gaussian, tile) pairs of all rasterizations together."""
        return sum(len(info["flatten_ids"]) for info in self.infos) if self.infos else None


Renderer = Callable[[str, Tensors, int, int], Callable[[], Rendered]]


@dataclass(frozen=True)
class Peer:
    """A renderer by name.

    Attributes:
        name: as printed.
        description: version and kind.
        renderer: (case, tensors, width, height) -> a call that renders.
        cases: those it can render.
        near_plane: Gaussians nearer than this are not drawn [world units].
        tolerance: how far its images and gradients may be from thermosplat's.
        release: gives back memory that it keeps between calls.
        captured: what is captured in CUDA graphs that are replayed: nothing, each of the two calls of a case
            ("call"), or, by ``torch.cuda.make_graphed_callables``, a function's forward and backward pass ("function").
    """

    name: str
    description: str
    renderer: Renderer
    cases: tuple[str, ...] = CASES
    near_plane: float = NEAR_PLANE
    tolerance: Tolerance = SAME_CONVENTIONS
    release: Callable[[], object] = lambda: None
    captured: Literal["call", "function"] | None = None


def _camera(t: Tensors, width: int, height: int) -> dict[str, Any]:
    return {"viewmats": t["viewmats"], "Ks": t["Ks"], "width": width, "height": height}


def thermosplat_peer(near_plane: float = NEAR_PLANE, deterministic: bool = False) -> Peer:
    """This project, through its public functions."""
    from thermosplat import __version__, rasterization, rasterization_rgbt

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

    name, suffix = ("deterministic", ", deterministic=True") if deterministic else (OURS, "")
    return Peer(name, f"thermosplat {__version__}, Warp kernels{suffix}", renderer)


def graph_peer() -> Peer:
    """thermosplat again, captured in a CUDA graph."""
    eager = thermosplat_peer()
    return replace(eager, name=GRAPH, description=f"{eager.description} replayed from a CUDA graph", captured="call")


def callable_peer() -> Peer:
    """thermosplat again, called as any function of torch's, whose two passes are CUDA graphs."""
    eager = thermosplat_peer()
    description = f"{eager.description} under torch.cuda.make_graphed_callables"
    return replace(eager, name=CALLABLE, description=description, captured="function")


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


def cuda_peers(names: Collection[str]) -> list[Peer]:
    """thermosplat and, of those named and importable, itself captured, gsplat's CUDA kernels and gswarp."""
    peers = [thermosplat_peer()]
    if "callable" in names:
        peers.append(callable_peer())
    if "graph" in names:
        peers.append(graph_peer())
    try:
        if "gsplat" in names:
            import gsplat

            renderer = gsplat_renderer(gsplat.rasterization, gsplat.spherical_harmonics, packed=False)
            peers.append(Peer("gsplat", f"gsplat {version('gsplat')}, CUDA kernels", renderer))
    except ImportError as error:
        print(f"gsplat is not importable ({error}); it is left out")
    try:
        if "gswarp" in names:
            from peers.gswarp import gswarp_peer

            peers.append(gswarp_peer())
    except ImportError as error:
        print(f"gswarp is not importable ({error}); it is left out")
    if "deterministic" in names:
        peers.append(thermosplat_peer(deterministic=True))
    return peers


def cpu_peers(names: Collection[str]) -> list[Peer]:
    """thermosplat and, of those named, a plain torch renderer and, where it can be imported, gsplat's torch reference.

    Args:
        names: "torch", "gsplat".
    """
    peers = [thermosplat_peer()]
    if "torch" in names:
        from peers.torch_renderer import torch_peer

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
