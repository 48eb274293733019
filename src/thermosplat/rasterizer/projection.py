"""Torch autograd over the steps of warp_kernels.

What is done for each Gaussian, and the blending, are one ``torch.autograd.Function`` each, whose passes look at torch's
memory as Warp arrays and run steps or their adjoints. Adjoints store gradients in memory that is not initialised where
they can. Only what a function saves keeps memory alive until its backward pass, after which torch
lets go of it. Work runs on torch's current stream. The blending's function is in blend_function.
"""

import math
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from thermosplat.torch_bridge.arrays import in_turns, keep, kept, kinds_of, lend, take_back, view, warp_device_of
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.color.color_step import ColorArrays, ColorSettings, sh_colors, sh_colors_adjoint
from warp_kernels.machinery.array_views import ArrayView, nothing
from warp_kernels.projection.projection import GaussianArrays, ProjectedArrays, ProjectionSettings
from warp_kernels.projection.projection_step import project, project_adjoint


def _empty(tensor: Tensor | None) -> Tensor | None:
    return torch.empty_like(tensor) if tensor is not None else None


def _zeros(tensor: Tensor | None, wanted: bool = True) -> Tensor | None:
    return torch.zeros_like(tensor) if wanted and tensor is not None else None


class ProjectedTensors(NamedTuple):
    """What ``Project`` returns: ``ProjectedArrays``'s fields [..., C, N], a vector's numbers in a last dimension."""

    means2d: Tensor
    depths: Tensor
    roots: Tensor
    compensations: Tensor | None  # None in the classic mode
    radii: Tensor  # int32, not differentiable
    extents: Tensor  # not differentiable
    packed_roots: Tensor  # not differentiable; its first three columns are the roots

    def arrays(self) -> ProjectedArrays:
        """The same memory as flat Warp arrays, which do not keep it alive."""
        scalar, vec2, vec3, vec4 = kinds_of(self.means2d.dtype)[:4]
        factors, packed_roots = self.compensations, view(self.packed_roots, vec4)
        return ProjectedArrays(
            means2d=view(self.means2d, vec2),
            depths=view(self.depths, scalar),
            roots=ArrayView(
                packed_roots.ptr, packed_roots.shape, vec3, packed_roots.device, strides=packed_roots.strides
            ),
            compensations=nothing(scalar, 1, warp_device_of(self.means2d.device))
            if factors is None
            else view(factors, scalar),
            radii=view(self.radii, wp.vec2i),
            extents=view(self.extents, vec2),
            packed_roots=packed_roots,
        )


class Harmonics(NamedTuple):
    """Coefficients of spherical harmonics [..., (C,) N, K, 3], to become colours in the view directions."""

    sh0: Tensor
    """Those of degree 0, or of all degrees."""
    shN: Tensor | None
    """Those of the other degrees, where they lie apart."""
    settings: ColorSettings


class ProjectInputs(NamedTuple):
    """What ``Project`` needs beside the tensors it differentiates."""

    settings: ProjectionSettings
    color_settings: tuple[ColorSettings, ...]
    """One for each pair of coefficients among the tensors."""
    images_shape: tuple[int, ...]
    turns: AbstractContextManager[Any]
    """The scene's lock; see ``in_turns``."""


class ProjectSaved(NamedTuple):
    """What the adjoint reads: arrays with their tensors when they are saved, the tensors when they come back."""

    means: Any
    quats: Any
    scales: Any
    covars: Any
    viewmats: Any
    Ks: Any
    packed_roots: Any
    """Of means2d and depths the adjoint reads only the gradients."""
    compensations: Any
    radii: Any
    colors: list[Any]
    coefficients: list[Any]


class ProjectGradients(NamedTuple):
    """Gradients to what ``Project`` takes, in front of those to the coefficients."""

    means: Tensor | None
    quats: Tensor | None
    scales: Tensor | None
    covars: Tensor | None
    opacities: None
    """They do not move what is projected; they are blended with."""
    thermal_opacities: None
    viewmats: Tensor | None
    Ks: Tensor | None
    inputs: None = None


class Project(torch.autograd.Function):
    """Projection, and colours in the view directions; see ``projection_step`` and ``color_step``.

    Returns the fields of ``ProjectedTensors``, the colours [images · N, 3] of each pair of coefficients, and the arrays
    of the former. One function for both, so that the gradient to the means is added up in place.
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
        inputs: ProjectInputs,
        *coefficients: Any,
    ) -> tuple[Any, ...]:
        settings = inputs.settings
        shape = (*inputs.images_shape, settings.num_gaussians)
        packed_roots = means.new_empty((*shape, 4))
        projected = ProjectedTensors(
            means2d=means.new_empty((*shape, 2)),
            depths=means.new_empty(shape),
            roots=packed_roots[..., :3],
            compensations=means.new_empty(shape) if settings.antialiased else None,
            radii=means.new_empty((*shape, 2), dtype=torch.int32),
            extents=means.new_empty((*shape, 2)),
            packed_roots=packed_roots,
        )
        p = projected.arrays()
        g = _gaussians(means, quats, scales, covars, opacities, thermal_opacities, viewmats, Ks)
        colors = [means.new_empty((math.prod(shape), 3)) for _ in inputs.color_settings]
        c = []
        with launches_on_torch_stream(means.device):
            project(g, settings, p)
            for sh0, shN, shown, how in zip(
                coefficients[::2], coefficients[1::2], colors, inputs.color_settings, strict=True
            ):
                c.append(ColorArrays(g.means, g.viewmats, *_by_degree(sh0, shN), p.radii, view(shown, g.means.dtype)))
                sh_colors(c[-1], how)
        ctx.mark_non_differentiable(projected.radii, projected.extents, packed_roots)
        ctx.set_materialize_grads(False)
        ctx.inputs, ctx.gaussians, ctx.projected, ctx.colors, ctx.turns = inputs, g, p, c, inputs.turns
        saved = ProjectSaved(
            means=(g.means, means),
            quats=(g.quats, quats),
            scales=(g.scales, scales),
            covars=(g.covars, covars),
            viewmats=(g.viewmats, viewmats),
            Ks=(g.Ks, Ks),
            packed_roots=(p.packed_roots, packed_roots),
            compensations=(p.compensations, projected.compensations),
            radii=(p.radii, projected.radii),
            colors=list(zip([arrays.colors for arrays in c], colors, strict=True)),
            coefficients=list(
                zip([array for arrays in c for array in (arrays.sh0, arrays.shN)], coefficients, strict=True)
            ),
        )
        keep(ctx, saved)
        return *projected, *colors, p

    @staticmethod
    @once_differentiable
    @in_turns
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        saved, count = kept(ctx), len(ProjectedTensors._fields)
        means, scales = saved.means, saved.scales
        v_projected, v_colors = ProjectedTensors(*gradients[:count]), gradients[count:-1]  # type: ignore[arg-type]
        to_gaussians, to_cameras = any(ctx.needs_input_grad[:4]), any(ctx.needs_input_grad[6:8])
        g, p, settings = ctx.gaussians, ctx.projected, ctx.inputs.settings
        p.roots.place(p.packed_roots.ptr)
        v_viewmats, v_Ks = _zeros(saved.viewmats, to_cameras), _zeros(saved.Ks, to_cameras)
        v_quats, v_scales, v_covars = None, None, None
        with launches_on_torch_stream(means.device):
            if v_viewmats is not None:
                g.viewmats.grad = view(v_viewmats, g.viewmats.dtype)
            v_means, v_coefficients = _color_adjoints(ctx, means, saved.coefficients, v_colors)
            if to_gaussians or to_cameras:
                added = v_means is not None
                v_means = torch.empty_like(means) if v_means is None else v_means
                v_quats, v_covars = _empty(saved.quats), _empty(saved.covars)
                v_roots = v_projected.roots
                if v_roots is not None and scales is not None and settings.num_cameras == 1:
                    # A thread reads its Gaussian's gradient before it writes: where there was one to the root, one to
                    # the scales. Nobody else has it: roots are not shown.
                    v_roots = v_roots.contiguous()
                    v_scales = v_roots.view_as(scales)
                else:
                    v_scales = _empty(scales)
                inputs = (g.means, g.quats, g.scales, g.covars, g.Ks)
                for array, gradient in zip(inputs, (v_means, v_quats, v_scales, v_covars, v_Ks), strict=True):
                    if gradient is not None:
                        array.grad = view(gradient, array.dtype)
                outputs = (p.means2d, p.depths, p.roots, p.compensations)
                given = (v_projected.means2d, v_projected.depths, v_roots, v_projected.compensations)
                for array, gradient in zip(outputs, given, strict=True):
                    if gradient is not None:
                        lend(array, gradient)
                project_adjoint(g, settings, p, store=True, add_to_means=added)
                take_back(*inputs, *outputs)
        take_back(g.means, g.viewmats)
        found = ProjectGradients(v_means, v_quats, v_scales, v_covars, None, None, v_viewmats, v_Ks)
        return *found, *v_coefficients


def _color_adjoints(
    ctx: Any, means: Tensor, coefficients: list[Any], v_colors: tuple[Tensor | None, ...]
) -> tuple[Tensor | None, list[Tensor | None]]:
    """Gradients to the means and to all coefficients, from those to the colours of each pair of coefficients."""
    v_means: Tensor | None = None
    v_coefficients: list[Tensor | None] = []
    for sh0, shN, arrays, settings, v_color in zip(
        coefficients[::2], coefficients[1::2], ctx.colors, ctx.inputs.color_settings, v_colors, strict=True
    ):
        if v_color is None:
            v_coefficients += [None, None]
            continue
        if shN is None:
            arrays.shN.place(arrays.sh0.ptr + arrays.sh0.strides[1])
        v_color = v_color.contiguous()
        # A thread reads its Gaussian's gradient before it writes: the one to the colours of one camera becomes the one
        # to the means.
        v_own = v_color.view_as(means) if settings.num_cameras == 1 else torch.empty_like(means)
        v_sh0, v_shN = torch.empty_like(sh0), _empty(shN)
        arrays.means.grad = view(v_own, arrays.means.dtype)
        arrays.sh0.grad, arrays.shN.grad = _by_degree(v_sh0, v_shN)
        lend(arrays.colors, v_color)
        sh_colors_adjoint(arrays, settings, store=True)
        take_back(arrays.sh0, arrays.shN, arrays.colors)
        v_means = v_own if v_means is None else v_means.add_(v_own)
        v_coefficients += [v_sh0, v_shN]
    return v_means, v_coefficients


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
