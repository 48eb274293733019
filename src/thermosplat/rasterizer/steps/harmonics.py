"""gsplat's ``spherical_harmonics``: sums of coefficients towards directions, without 3DGS's half and limit."""

from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import pad

from thermosplat.errors import UserError
from thermosplat.rasterizer.arguments import checked_choice
from thermosplat.rasterizer.blended_values import GROUP
from thermosplat.rasterizer.graph_breaks import not_compiled, refuse_transforms
from thermosplat.rasterizer.projection_autograd import by_degree
from thermosplat.torch_bridge.arrays import kinds_of, lend, view
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.color.color_step import ColorArrays, ColorSettings, sh_colors, sh_colors_adjoint


@not_compiled
def spherical_harmonics(degrees_to_use: int, *tensors: Any, **named: Any) -> Tensor:
    """Sums spherical harmonics towards directions; gsplat's function in both of its forms.

    gsplat 1.5.3 has ``(degrees_to_use, dirs, coeffs, masks=None)``. Its main branch has ``(degrees_to_use, means,
    viewmats, coeffs, masks=None, batch_ids=None, camera_ids=None, gaussian_ids=None, viewmats_rs=None)``, where the
    directions go from the cameras to the means. Differentiable in all of them but the masks and the ids, on the CPU and
    on CUDA, in float32 or float64. A colour of 3DGS is the sum + 0.5, no less than 0.

    Args:
        degrees_to_use: Active degree, 0 to 4.
        *tensors: As below, in gsplat's order.
        **named: As below, by name. dirs: directions of any length, [..., 3]. coeffs: coefficients [..., K, D] with K at
            least (degrees_to_use + 1)², which may have 16 bits; in the second form [N, K, D], or [nnz, K, D] with ids.
            masks: where False the sum is 0 and has no gradient, [...]; in the second form [..., C, N] or [nnz]. means:
            [..., N, 3]. viewmats: world to camera, [..., C, 4, 4], whose rotations are taken for orthonormal.
            batch_ids, camera_ids, gaussian_ids: of packed Gaussians, [nnz]. viewmats_rs: view matrices at the end of
            the exposure; the cameras are half way.

    Returns:
        The sums, [..., D]; in the second form [..., C, N, D] or [nnz, D].

    Raises:
        UserError: a shape, type or degree is wrong.
    """
    degrees_to_use = checked_choice("degrees_to_use", degrees_to_use)
    if degrees_to_use is None:
        raise UserError("degrees_to_use must be one of 0, 1, 2, 3, 4, got None.")
    numbers = [one for one in tensors if isinstance(one, Tensor) and one.is_floating_point()]
    if "viewmats" in named or len(numbers) > 2:
        return _seen_from_cameras(degrees_to_use, *tensors, **named)
    return _towards(degrees_to_use, *tensors, **named)


def _seen_from_cameras(
    degree: int,
    means: Tensor,
    viewmats: Tensor,
    coeffs: Tensor,
    masks: Tensor | None = None,
    batch_ids: Tensor | None = None,
    camera_ids: Tensor | None = None,
    gaussian_ids: Tensor | None = None,
    viewmats_rs: Tensor | None = None,
) -> Tensor:
    """The form of gsplat's main branch."""
    positions = _camera_positions(viewmats)
    if viewmats_rs is not None:
        positions = 0.5 * (positions + _camera_positions(viewmats_rs))
    if gaussian_ids is None:
        dirs = means.unsqueeze(-3) - positions.unsqueeze(-2)
        return _towards(degree, dirs, coeffs.expand(*dirs.shape[:-1], *coeffs.shape[-2:]), masks)
    if camera_ids is None:
        raise UserError("camera_ids must be given with gaussian_ids, got None.")
    scenes = torch.zeros_like(gaussian_ids) if batch_ids is None else batch_ids
    flat_means, flat_positions = means.reshape(-1, *means.shape[-2:]), positions.reshape(-1, *positions.shape[-2:])
    dirs = flat_means[scenes.long(), gaussian_ids.long()] - flat_positions[scenes.long(), camera_ids.long()]
    return _towards(degree, dirs, coeffs, masks)


def _camera_positions(viewmats: Tensor) -> Tensor:
    """[..., C, 3] of rigid view matrices: -Rᵀ t."""
    return -(viewmats[..., :3, :3].transpose(-1, -2) @ viewmats[..., :3, 3:])[..., 0]


def _towards(degree: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None = None) -> Tensor:
    """The form of gsplat 1.5.3."""
    refuse_transforms()
    if isinstance(coeffs, Tensor) and isinstance(dirs, Tensor) and coeffs.dtype in (torch.float16, torch.bfloat16):
        coeffs = coeffs.to(dirs.dtype)
    for name, tensor in (("dirs", dirs), ("coeffs", coeffs)):
        if not isinstance(tensor, Tensor) or tensor.dtype not in (torch.float32, torch.float64):
            found = tensor.dtype if isinstance(tensor, Tensor) else type(tensor).__name__
            raise UserError(f"{name} must be a float32 or float64 tensor, got {found}.")
    lead, needed = dirs.shape[:-1], (degree + 1) ** 2
    if dirs.dim() < 1 or dirs.shape[-1] != 3:
        raise UserError(f"dirs must have shape [..., 3], got {list(dirs.shape)}.")
    if coeffs.dtype != dirs.dtype or coeffs.device != dirs.device:
        raise UserError(f"coeffs must be {dirs.dtype} on {dirs.device}, as dirs are, got {coeffs.dtype}.")
    if coeffs.shape[-1:] == (0,):
        raise UserError(f"coeffs must have at least one channel, got {list(coeffs.shape)}.")
    if coeffs.shape[:-2] != lead or coeffs.dim() != len(lead) + 2 or coeffs.shape[-2] < needed:
        raise UserError(
            f"coeffs must have shape {[*lead, 'K', 'D']} with K at least {needed} for degree {degree}, "
            f"got {list(coeffs.shape)}."
        )
    if masks is not None and masks.shape != lead:
        raise UserError(f"masks must have shape {list(lead)}, got {list(masks.shape)}.")
    rows = dirs.numel() // 3
    drawn = torch.ones(rows, dtype=torch.bool, device=dirs.device) if masks is None else masks.reshape(rows) != 0
    flat = coeffs.reshape(rows, *coeffs.shape[-2:])
    directions, sums = dirs.reshape(rows, 3).contiguous(), []
    for first in range(0, flat.shape[-1], GROUP):
        group = flat[..., first : first + GROUP]
        group = pad(group, (0, GROUP - group.shape[-1])).contiguous()
        sums.append(HarmonicSums.apply(directions, group, drawn, degree))
    joined = sums[0] if len(sums) == 1 else torch.cat(sums, -1)
    return joined[:, : flat.shape[-1]].reshape(*lead, flat.shape[-1])


class HarmonicSums(torch.autograd.Function):
    """Sums [R, 3] of coefficients [R, K, 3] towards directions [R, 3]: the colours of a camera at the origin."""

    @staticmethod
    def forward(ctx: Any, directions: Tensor, coefficients: Tensor, drawn: Tensor, degree: int) -> Tensor:
        """``drawn``: bool [R], False where there is no sum."""
        sums = torch.zeros_like(directions)
        ctx.degree = degree
        ctx.save_for_backward(directions, coefficients, drawn)
        if len(directions) > 0:
            made = _arrays(directions, coefficients, drawn, sums, degree)
            with launches_on_torch_stream(directions.device):
                sh_colors(made.arrays, made.settings)
        return sums

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_sums: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients to directions and coefficients."""
        directions, coefficients, drawn = ctx.saved_tensors
        v_directions, v_coefficients = torch.zeros_like(directions), torch.zeros_like(coefficients)
        if len(directions) > 0:
            v_sums = v_sums.contiguous()
            made = _arrays(directions, coefficients, drawn, v_sums, ctx.degree)
            a, kinds = made.arrays, kinds_of(directions.dtype)
            a.camera_positions = view(made.origin, wp.vec3d)
            a.means.grad = view(v_directions, kinds.vec3)
            a.sh0.grad, a.shN.grad = by_degree(v_coefficients, None)
            lend(a.colors, v_sums)
            with launches_on_torch_stream(directions.device):
                sh_colors_adjoint(a, made.settings, store=True)
        return v_directions, v_coefficients, None, None


class _Made(NamedTuple):
    arrays: ColorArrays
    settings: ColorSettings
    viewmat: Tensor
    origin: Tensor


def _arrays(directions: Tensor, coefficients: Tensor, drawn: Tensor, sums: Tensor, degree: int) -> _Made:
    """Arrays of tensors' memory, and the camera, which is at the origin; the caller holds both."""
    kinds = kinds_of(directions.dtype)
    viewmat = torch.eye(4, dtype=directions.dtype, device=directions.device)
    origin = torch.zeros(3, dtype=torch.float64, device=directions.device)
    sh0, shN = by_degree(coefficients, None)
    arrays = ColorArrays(
        view(directions, kinds.vec3),
        view(viewmat, kinds.mat44),
        sh0,
        shN,
        view(drawn, wp.bool),
        view(sums, kinds.vec3),
    )
    return _Made(arrays, ColorSettings(degree, len(directions), 1, shifted=False, clamped=False), viewmat, origin)
