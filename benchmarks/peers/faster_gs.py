"""Faster-GS (CVPR 2026, Apache-2.0), as a peer: its CUDA backend without the framework around it.

It activates scales, opacities and rotations itself, so that it is given what they are before: leaves of its own, made
before anything is timed. Its gradients are compared after the chain rule. It renders RGB with spherical harmonics and
no image of alphas: only colours are compared, and its backward pass has no gradient to alphas to work on. It uses fast
mathematics, does not clamp alpha, and draws the Gaussian that ends a pixel.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from measuring.agreement import OTHER_CONVENTIONS
from peers.peer import NEAR_PLANE, Peer, RawParameters, Rendered, Tensors

FAR_PLANE = 1e10
"""Gaussians farther than this are not drawn [world units]; thermosplat's default."""

EPS = 1e-6
"""Opacities are kept so far from 0 and 1 that their logits are finite, as Faster-GS itself keeps them."""


def raw_leaves(t: Tensors) -> Tensors:
    """Parameters before their activations: logarithms, logits, coefficients of degree 0 and the others."""
    raw = {
        "means": t["means"],
        "quats": t["quats"],
        "log_scales": t["scales"].log(),
        "logit_opacities": t["opacities"].logit(eps=EPS)[:, None],
        "sh0": t["sh"][:, :1],
        "shN": t["sh"][:, 1:],
    }
    leaves = {
        name: tensor.detach().clone(memory_format=torch.contiguous_format).requires_grad_()
        for name, tensor in raw.items()
    }
    return leaves | {"viewmats": t["viewmats"], "Ks": t["Ks"]}


def gradients_of_activated(t: Tensors, found: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """Gradients to means, quaternions, scales, opacities and coefficients of those to the raw leaves.

    Args:
        t: the activated parameters.
        found: gradients to the leaves of ``raw_leaves``, in their order.
    """
    means, quats, log_scales, logits, sh0, shN = found
    opacities = t["opacities"].detach().clamp(EPS, 1.0 - EPS)
    to_opacities = logits[:, 0] / (opacities * (1.0 - opacities))
    return means, quats, log_scales / t["scales"].detach(), to_opacities, torch.cat([sh0, shN], 1)


def settings_of(t: Tensors, width: int, height: int) -> dict[str, object]:
    """The camera with the names of ``RasterizerSettings``."""
    view, K = t["viewmats"][0], t["Ks"][0]
    return {
        "w2c": view.contiguous(),
        "cam_position": torch.linalg.inv(view)[:3, 3].contiguous(),
        "bg_color": torch.zeros(3, device=view.device),
        "active_sh_bases": 16,
        "width": width,
        "height": height,
        "focal_x": K[0, 0].item(),
        "focal_y": K[1, 1].item(),
        "center_x": K[0, 2].item(),
        "center_y": K[1, 2].item(),
        "near_plane": NEAR_PLANE,
        "far_plane": FAR_PLANE,
        "proper_antialiasing": False,
    }


def faster_gs_peer() -> Peer:
    """Faster-GS; importing it fails where it is not installed, and it renders on CUDA only."""
    from FasterGSCudaBackend.torch_bindings import RasterizerSettings, diff_rasterize

    def renderer(case: str, t: Tensors, width: int, height: int) -> Callable[[], Rendered]:
        settings = RasterizerSettings(**settings_of(t, width, height))
        none = torch.empty(0, device=t["means"].device)

        def render() -> Rendered:
            image = diff_rasterize(
                means=t["means"],
                scales=t["log_scales"],
                rotations=t["quats"],
                opacities=t["logit_opacities"],
                sh_coefficients_0=t["sh0"],
                sh_coefficients_rest=t["shN"],
                densification_info=none,
                rasterizer_settings=settings,
            )
            return Rendered([image.permute(1, 2, 0)[None]], [])

        return render

    return Peer(
        "Faster-GS",
        "Faster-GS, CUDA kernels with the activations in them",
        renderer,
        cases=("rgb",),
        tolerance=OTHER_CONVENTIONS,
        raw=RawParameters(raw_leaves, gradients_of_activated),
        num_images=1,
    )
