"""Torch autograd over the steps of warp_kernels.

Each step of the rasterizer is one ``torch.autograd.Function``, whose passes look at torch's memory as Warp arrays and
run the step or its adjoint. Adjoints store gradients in memory that is not
initialised where they can. Only what a function saves keeps memory alive until its backward pass, after which torch
lets go of it. Work runs on torch's current stream. The blending's function is in blend_function.
"""

from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from thermosplat.warp_bridge import keep, kept, kinds_of, lend, take_back, view, warp_device_of
from thermosplat.warp_streams import launches_on_torch_stream
from warp_kernels.array_views import ArrayView, nothing
from warp_kernels.color_step import ColorArrays, ColorSettings, sh_colors, sh_colors_adjoint
from warp_kernels.projection import GaussianArrays, ProjectedArrays, ProjectionSettings
from warp_kernels.projection_step import project, project_adjoint


def _empty(tensor: Tensor | None) -> Tensor | None:
    return torch.empty_like(tensor) if tensor is not None else None


def _zeros(tensor: Tensor | None, wanted: bool = True) -> Tensor | None:
    return torch.zeros_like(tensor) if wanted and tensor is not None else None


class ProjectedTensors(NamedTuple):
    """What ``Project`` returns: ``ProjectedArrays``'s fields [..., C, N], a vector's numbers in a last dimension."""

    means2d: Tensor
    depths: Tensor
    roots: Tensor
    compensations: Tensor  # empty in the classic mode
    radii: Tensor  # int32, not differentiable
    extents: Tensor  # not differentiable
    remainders: Tensor  # not differentiable

    def arrays(self) -> ProjectedArrays:
        """The same memory as flat Warp arrays, which do not keep it alive."""
        scalar, vec2, vec3 = kinds_of(self.means2d.dtype)[:3]
        return ProjectedArrays(*map(view, self, (vec2, scalar, vec3, scalar, wp.vec2i, vec2, vec2)))


class Project(torch.autograd.Function):
    """Projection; see ``projection_step``.

    Returns the fields of ``ProjectedTensors``, the means once more, and the arrays of the former.

    What is computed from the means of projected Gaussians should take those: its gradient is then added to by the
    projection's adjoint, instead of a second gradient of that size by torch.
    """

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor | None,
        scales: Tensor | None,
        covars: Tensor | None,
        opacities: Tensor,
        thermal_opacities: Tensor,
        viewmats: Tensor,
        Ks: Tensor,
        settings: ProjectionSettings,
        images_shape: tuple[int, ...],
    ) -> tuple[Any, ...]:
        shape = (*images_shape, settings.num_gaussians)
        projected = ProjectedTensors(
            means2d=means.new_empty((*shape, 2)),
            depths=means.new_empty(shape),
            roots=means.new_empty((*shape, 3)),
            compensations=means.new_empty(shape if settings.antialiased else 0),
            radii=means.new_empty((*shape, 2), dtype=torch.int32),
            extents=means.new_empty((*shape, 2)),
            remainders=means.new_empty((*shape, 2)),
        )
        p = projected.arrays()
        g = _gaussians(means, quats, scales, covars, opacities, thermal_opacities, viewmats, Ks)
        with launches_on_torch_stream(means.device):
            project(g, settings, p)
        ctx.mark_non_differentiable(projected.radii, projected.extents, projected.remainders)
        ctx.set_materialize_grads(False)
        ctx.settings, ctx.gaussians, ctx.projected = settings, g, p
        keep(
            ctx,
            (g.means, means),
            (g.quats, quats),
            (g.scales, scales),
            (g.covars, covars),
            (g.viewmats, viewmats),
            (g.Ks, Ks),
            # Of means2d and depths the adjoint reads only the gradients.
            (p.roots, projected.roots),
            (p.compensations, projected.compensations),
            (p.radii, projected.radii),
        )
        return *projected, means.view_as(means), p

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        means, quats, scales, covars, viewmats, Ks, *_held = kept(ctx)
        to_cameras = ctx.needs_input_grad[6] or ctx.needs_input_grad[7]
        *v_projected, given = gradients[:-1]
        v_means = torch.empty_like(means) if given is None else given.contiguous()
        v_quats, v_covars = _empty(quats), _empty(covars)
        v_roots = v_projected[2]
        if v_roots is not None and scales is not None and ctx.settings.num_cameras == 1:
            # A thread reads its Gaussian's gradient before it writes: where there was one to the root, one to the
            # scales. Nobody else has it: roots are not shown.
            v_roots = v_projected[2] = v_roots.contiguous()
            v_scales: Tensor | None = v_roots.view_as(scales)
        else:
            v_scales = _empty(scales)
        v_viewmats, v_Ks = _zeros(viewmats, to_cameras), _zeros(Ks, to_cameras)
        g, p = ctx.gaussians, ctx.projected
        inputs = (g.means, g.quats, g.scales, g.covars, g.viewmats, g.Ks)
        outputs = (p.means2d, p.depths, p.roots, p.compensations)
        for array, gradient in zip(inputs, (v_means, v_quats, v_scales, v_covars, v_viewmats, v_Ks), strict=True):
            if gradient is not None:
                array.grad = view(gradient, array.dtype)
        for array, gradient in zip(outputs, v_projected, strict=False):
            lend(array, gradient)
        with launches_on_torch_stream(means.device):
            project_adjoint(g, ctx.settings, p, store=True, add_to_means=given is not None)
        take_back(*inputs, *outputs)
        return v_means, v_quats, v_scales, v_covars, None, None, v_viewmats, v_Ks, None, None


def _gaussians(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    covars: Tensor | None,
    opacities: Tensor,
    thermal_opacities: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
) -> GaussianArrays:
    kinds, device = kinds_of(means.dtype), warp_device_of(means.device)
    bound = view(opacities, kinds.scalar)
    return GaussianArrays(
        means=view(means, kinds.vec3),
        quats=nothing(kinds.vec4, 1, device) if quats is None else view(quats, kinds.vec4),
        scales=nothing(kinds.vec3, 1, device) if scales is None else view(scales, kinds.vec3),
        covars=None if covars is None else view(covars, kinds.vec6),
        opacities=bound,
        thermal_opacities=bound if thermal_opacities is opacities else view(thermal_opacities, kinds.scalar),
        viewmats=view(viewmats, kinds.mat44),
        Ks=view(Ks, kinds.mat33),
    )


class ShColors(torch.autograd.Function):
    """Colours from spherical harmonics; see ``color_step``. ``shN`` None: ``sh0`` holds all coefficients."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        viewmats: Tensor,
        sh0: Tensor,
        shN: Tensor | None,
        radii: Tensor,
        settings: ColorSettings,
    ) -> Tensor:
        colors = means.new_empty((radii.numel() // 2, 3))
        arrays = _color_arrays(means, viewmats, sh0, shN, radii, colors)
        with launches_on_torch_stream(means.device):
            sh_colors(arrays, settings)
        ctx.settings, ctx.colors = settings, arrays
        keep(
            ctx,
            (arrays.means, means),
            (arrays.viewmats, viewmats),
            (arrays.sh0, sh0),
            (arrays.shN, shN),
            (arrays.radii, radii),
            (arrays.colors, colors),
        )
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_colors: Tensor) -> tuple[Tensor | None, ...]:
        means, viewmats, sh0, shN, *_held = kept(ctx)
        arrays = ctx.colors
        if shN is None:
            arrays.shN.place(arrays.sh0.ptr + arrays.sh0.strides[1])
        v_colors = v_colors.contiguous()
        # As with roots and scales in Project: the gradient to the colours of one camera becomes the one to the means.
        v_means = v_colors.view_as(means) if ctx.settings.num_cameras == 1 else torch.empty_like(means)
        v_sh0, v_shN = torch.empty_like(sh0), _empty(shN)
        v_viewmats = _zeros(viewmats, ctx.needs_input_grad[1])
        arrays.means.grad = view(v_means, arrays.means.dtype)
        arrays.sh0.grad, arrays.shN.grad = _by_degree(v_sh0, v_shN)
        if v_viewmats is not None:
            arrays.viewmats.grad = view(v_viewmats, arrays.viewmats.dtype)
        lend(arrays.colors, v_colors)
        with launches_on_torch_stream(means.device):
            sh_colors_adjoint(arrays, ctx.settings, store=True)
        take_back(arrays.means, arrays.viewmats, arrays.sh0, arrays.shN, arrays.colors)
        return v_means, v_viewmats, v_sh0, v_shN, None, None


def _color_arrays(
    means: Tensor, viewmats: Tensor, sh0: Tensor, shN: Tensor | None, radii: Tensor, colors: Tensor
) -> ColorArrays:
    kinds = kinds_of(means.dtype)
    coefficients = _by_degree(sh0, shN)
    positions = (view(means, kinds.vec3), view(viewmats, kinds.mat44))
    return ColorArrays(*positions, *coefficients, view(radii, wp.vec2i), view(colors, kinds.vec3))


def _by_degree(sh0: Tensor, shN: Tensor | None) -> tuple[ArrayView, ArrayView]:
    """Coefficients of degree 0 and of the others, where they are one tensor as two views of it."""
    kind, count = kinds_of(sh0.dtype).vec3, sh0.shape[-2]
    rows = sh0.numel() // (3 * count)
    if shN is not None:
        return view(sh0, kind, rows, 1), view(shN, kind, rows, shN.shape[-2])
    vector = 3 * sh0.element_size()
    strides, device = (vector * count, vector), warp_device_of(sh0.device)
    first = ArrayView(sh0.data_ptr(), (rows, 1), kind, device, strides=strides)
    return first, ArrayView(sh0.data_ptr() + vector, (rows, count - 1), kind, device, strides=strides)
