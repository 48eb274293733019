"""Torch autograd over what is done for each Gaussian: the steps that project it, and evaluate its colours.

This and the blending (``blending_autograd``) are one ``torch.autograd.Function`` each, whose passes look at torch's
memory as Warp arrays and run steps or their adjoints. Adjoints store gradients in memory that is not initialised where
they can. Only what a function saves keeps memory alive until its backward pass, after which torch lets go of it. Work
runs on torch's current stream. Where nothing is recorded, a forward pass is called without torch's machinery.
"""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor

from thermosplat.torch_bridge.arrays import (
    kept,
    kinds_of,
    lend,
    once_in_turns,
    take_back,
    vector_of,
    view,
    warp_device_of,
)
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.color.color_step import ColorArrays, ColorSettings, sh_colors, sh_colors_adjoint
from warp_kernels.machinery.array_views import ArrayView, nothing
from warp_kernels.projection.lens_step import (
    LensArrays,
    LensSettings,
    project_through_lenses,
    project_through_lenses_adjoint,
)
from warp_kernels.projection.plain_camera_step import project_gaussians, project_gaussians_adjoint
from warp_kernels.projection.projection import GaussianArrays, ProjectedArrays, ProjectionSettings


class ProjectedTensors(NamedTuple):
    """``ProjectedArrays``'s fields [..., C, N] for torch, a vector's numbers in a last dimension."""

    means2d: Tensor
    depths: Tensor
    roots: Tensor
    compensations: Tensor | None  # None in the classic mode
    visible: Tensor  # bool, not differentiable, as the others below
    extents: Tensor
    packed_roots: Tensor  # the first three columns are the roots

    def arrays(self) -> ProjectedArrays:
        """The same memory as flat Warp arrays, which do not keep it alive."""
        means2d, depths, _, compensations, visible, extents, packed_roots = self
        scalar, vec2, vec3, vec4 = kinds_of(means2d.dtype)[:4]
        device, shape = warp_device_of(means2d.device), (depths.numel(),)
        packed = ArrayView(packed_roots.data_ptr(), shape, vec4, device)
        return ProjectedArrays(
            ArrayView(means2d.data_ptr(), shape, vec2, device),
            ArrayView(depths.data_ptr(), shape, scalar, device),
            ArrayView(packed.ptr, shape, vec3, device, None, packed.strides),
            None if compensations is None else ArrayView(compensations.data_ptr(), shape, scalar, device),
            ArrayView(visible.data_ptr(), shape, wp.bool, device),
            ArrayView(extents.data_ptr(), shape, vec2, device),
            packed,
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

    opacities: ArrayView
    """They do not move what is projected; they bound what is drawn. [scenes · N], not read after the call."""
    thermal_opacities: ArrayView
    settings: ProjectionSettings
    color_settings: tuple[ColorSettings, ...]
    """One for each pair of coefficients among the tensors."""
    images_shape: tuple[int, ...]
    turns: AbstractContextManager[Any]
    """The scene's lock; see ``once_in_turns``."""
    lens: LensSettings | None = None
    """Where there are lenses."""


class ProjectSaved(NamedTuple):
    """What the adjoint reads, as tensors or as the arrays of their memory."""

    means: Any
    quats: Any
    scales: Any
    covars: Any
    viewmats: Any
    Ks: Any
    lenses: Any
    motions: Any
    packed_roots: Any
    """Of means2d and depths the adjoint reads only the gradients."""
    compensations: Any
    visible: Any
    slopes: Any
    """These three of lenses; see ``LensArrays``."""
    times: Any
    leads: Any


class Project(torch.autograd.Function):
    """Projection, and colours in the view directions; see ``plain_camera_step`` and ``color_step``.

    Returns the differentiable fields of ``ProjectedTensors``, the colours [images · N, 3] of each pair of coefficients,
    the other fields in a tuple, and the arrays of all. One function for both, so that the gradient to the means is
    added up in place.
    """

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor | None,
        scales: Tensor | None,
        covars: Tensor | None,
        viewmats: Tensor,
        Ks: Tensor,
        lenses: Tensor | None,
        motions: Tensor | None,
        inputs: ProjectInputs,
        *coefficients: Any,
    ) -> tuple[Any, ...]:
        settings = inputs.settings
        shape = (*inputs.images_shape, settings.num_gaussians)
        entries = settings.num_images * settings.num_gaussians
        packed_roots, depths = means.new_empty(*shape, 4), means.new_empty(*shape)
        words = means.new_empty(-(-entries // 4) * 4, dtype=torch.bool)  # whole ones, for replays to copy
        projected = ProjectedTensors(
            means.new_empty(*shape, 2),
            depths,
            packed_roots[..., :3],
            means.new_empty(*shape) if settings.antialiased else None,
            words.as_strided(shape, depths.stride()),
            means.new_empty(*shape, 2),
            packed_roots,
        )
        p, g = projected.arrays(), _gaussians(means, quats, scales, covars, viewmats, Ks, inputs)
        recorded = ctx is not None and True in ctx.needs_input_grad
        through_lens, rolling = recorded and lenses is not None, recorded and motions is not None
        slopes = means.new_empty(12, *shape) if through_lens else None
        times = means.new_empty(*shape, dtype=torch.float64) if rolling else None
        leads = means.new_empty(6, *shape) if rolling else None
        lens = None if lenses is None else _lenses(lenses, motions, slopes, times, leads)
        colors, c = [], []
        with launches_on_torch_stream(means.device) as device:
            if lens is None or inputs.lens is None:
                project_gaussians(g, settings, p)
            else:
                project_through_lenses(g, lens, inputs.lens, settings, p)
            for sh0, shN, how in zip(coefficients[::2], coefficients[1::2], inputs.color_settings, strict=True):
                colors.append(means.new_empty(entries, 3))
                evaluated = ArrayView(colors[-1].data_ptr(), (entries,), g.means.dtype, device)
                c.append(ColorArrays(g.means, g.viewmats, *by_degree(sh0, shN), p.visible, evaluated))
                sh_colors(c[-1], how)
        if recorded:
            ctx.set_materialize_grads(False)
            ctx.settings, ctx.gaussians, ctx.projected, ctx.lens = settings, g, p, lens
            ctx.colors, ctx.color_settings, ctx.lens_settings = c, inputs.color_settings, inputs.lens
            ctx.turns = inputs.turns
            # in the order of ProjectSaved, and behind that of the colours
            of_images, of_pairs = (None, None), (None, None, None)
            if lens is not None:
                of_images, of_pairs = (lens.coefficients, lens.motions), (lens.slopes, lens.times, lens.leads)
            arrays = [g.means, g.quats, g.scales, g.covars, g.viewmats, g.Ks, *of_images]
            arrays += [p.packed_roots, p.compensations, p.visible, *of_pairs]
            arrays += [array for one in c for array in (one.sh0, one.shN)]
            arrays += [one.colors for one in c]
            tensors = [means, quats, scales, covars, viewmats, Ks, lenses, motions]
            tensors += [packed_roots, projected.compensations, projected.visible, slopes, times, leads]
            tensors += [*coefficients, *colors]
            ctx.arrays = arrays  # see ``kept``
            ctx.save_for_backward(*tensors)
        return *projected[:4], *colors, projected[4:], p

    @staticmethod
    @once_in_turns
    def backward(ctx: Any, *gradients: Any) -> tuple[Tensor | None, ...]:
        tensors, count = kept(ctx), len(ProjectSaved._fields)
        saved, coefficients = ProjectSaved(*tensors[:count]), tensors[count:]
        v_means2d, v_depths, v_roots, v_compensations, *v_colors = gradients[:-2]
        means, scales = saved.means, saved.scales
        to_gaussians, to_cameras = True in ctx.needs_input_grad[:4], True in ctx.needs_input_grad[4:8]
        g, p, lens, settings = ctx.gaussians, ctx.projected, ctx.lens, ctx.settings
        p.roots.place(p.packed_roots.ptr)
        v_viewmats, v_Ks, v_lenses, v_motions = None, None, None, None
        if to_cameras:
            cameras = (saved.viewmats, saved.Ks, saved.lenses, saved.motions)
            v_viewmats, v_Ks, v_lenses, v_motions = (None if one is None else torch.zeros_like(one) for one in cameras)
        v_quats, v_scales, v_covars = None, None, None
        with launches_on_torch_stream(means.device):
            _write_to(g.viewmats, v_viewmats)
            v_means, v_coefficients = _color_adjoints(ctx, means, coefficients, v_colors)
            if to_gaussians or to_cameras:
                added = v_means is not None
                v_means = torch.empty_like(means) if v_means is None else v_means
                v_quats = None if saved.quats is None else torch.empty_like(saved.quats)
                v_covars = None if saved.covars is None else torch.empty_like(saved.covars)
                if v_roots is not None and scales is not None and settings.num_cameras == 1:
                    # A thread reads its Gaussian's gradient before it writes: where there was one to the root, one to
                    # the scales. Nobody else has it: roots are not shown.
                    v_roots = v_roots.contiguous()
                    v_scales = v_roots.view_as(scales)
                elif scales is not None:
                    v_scales = torch.empty_like(scales)
                for array, gradient in (
                    (g.means, v_means),
                    (g.quats, v_quats),
                    (g.scales, v_scales),
                    (g.covars, v_covars),
                    (g.Ks, v_Ks),
                ):
                    _write_to(array, gradient)
                lend(p.means2d, v_means2d)
                lend(p.depths, v_depths)
                lend(p.roots, v_roots)
                if p.compensations is not None:
                    lend(p.compensations, v_compensations)
                if lens is None:
                    project_gaussians_adjoint(g, settings, p, store=True, add_to_means=added)
                else:
                    _write_to(lens.coefficients, v_lenses)
                    _write_to(lens.motions, v_motions)
                    how = ctx.lens_settings
                    project_through_lenses_adjoint(g, lens, how, settings, p, store=True, add_to_means=added)
                    take_back(lens.coefficients, lens.motions)
        take_back(g.means, g.quats, g.scales, g.covars, g.viewmats, g.Ks)
        take_back(p.means2d, p.depths, p.roots, p.compensations)
        return v_means, v_quats, v_scales, v_covars, v_viewmats, v_Ks, v_lenses, v_motions, None, *v_coefficients


def _write_to(array: ArrayView | None, gradient: Tensor | None) -> None:
    """Gives an array of a step's inputs memory for a gradient, if there is any."""
    if gradient is not None and array is not None:
        array.gradient_at(gradient.data_ptr())


def _color_adjoints(
    ctx: Any, means: Tensor, coefficients: Sequence[Any], v_colors: Sequence[Tensor | None]
) -> tuple[Tensor | None, list[Tensor | None]]:
    """Gradients to the means and to all coefficients, from those to the colours of each pair of coefficients.

    Behind the coefficients may lie anything else.
    """
    v_means: Tensor | None = None
    v_coefficients: list[Tensor | None] = []
    for k, (arrays, settings, v_color) in enumerate(zip(ctx.colors, ctx.color_settings, v_colors, strict=True)):
        sh0, shN = coefficients[2 * k : 2 * k + 2]
        if v_color is None:
            v_coefficients += [None, None]
            continue
        if shN is None:
            arrays.shN.place(arrays.sh0.ptr + arrays.sh0.strides[1])
        v_color = v_color.contiguous()
        # A thread reads its Gaussian's gradient before it writes: the one to the colours of one camera becomes the one
        # to the means.
        v_own = v_color.view_as(means) if settings.num_cameras == 1 else torch.empty_like(means)
        v_sh0, v_shN = torch.empty_like(sh0), None if shN is None else torch.empty_like(shN)
        _write_to(arrays.means, v_own)
        arrays.sh0.grad, arrays.shN.grad = by_degree(v_sh0, v_shN)
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
    viewmats: Tensor,
    Ks: Tensor,
    inputs: ProjectInputs,
) -> GaussianArrays:
    _, _, vec3, vec4, vec6, mat33, mat44 = kinds_of(means.dtype)
    rows, images, device = inputs.opacities.shape, (inputs.settings.num_images,), inputs.opacities.device
    return GaussianArrays(
        ArrayView(means.data_ptr(), rows, vec3, device),
        nothing(vec4, 1, device) if quats is None else ArrayView(quats.data_ptr(), rows, vec4, device),
        nothing(vec3, 1, device) if scales is None else ArrayView(scales.data_ptr(), rows, vec3, device),
        None if covars is None else ArrayView(covars.data_ptr(), rows, vec6, device),
        inputs.opacities,
        inputs.thermal_opacities,
        ArrayView(viewmats.data_ptr(), images, mat44, device),
        ArrayView(Ks.data_ptr(), images, mat33, device),
    )


def _lenses(
    lenses: Tensor, motions: Tensor | None, slopes: Tensor | None, times: Tensor | None, leads: Tensor | None
) -> LensArrays:
    scalar = kinds_of(lenses.dtype).scalar
    return LensArrays(
        coefficients=view(lenses, vector_of(lenses.shape[-1], lenses.dtype)),
        motions=None if motions is None else view(motions, vector_of(motions.shape[-1], motions.dtype)),
        slopes=None if slopes is None else view(slopes, scalar, 12, slopes.numel() // 12),
        times=None if times is None else view(times, wp.float64),
        leads=None if leads is None else view(leads, scalar, 6, leads.numel() // 6),
    )


def by_degree(sh0: Tensor, shN: Tensor | None) -> tuple[ArrayView, ArrayView]:
    """Coefficients of degree 0 and of the others, where they are one tensor as two views of it."""
    kind, count, device = kinds_of(sh0.dtype).vec3, sh0.shape[-2], warp_device_of(sh0.device)
    rows, ptr = sh0.numel() // (3 * count), sh0.data_ptr()
    if shN is not None:
        return ArrayView(ptr, (rows, 1), kind, device), view(shN, kind, rows, shN.shape[-2])
    vector = 3 * sh0.element_size()
    strides = (vector * count, vector)
    first = ArrayView(ptr, (rows, 1), kind, device, None, strides)
    return first, ArrayView(ptr + vector, (rows, count - 1), kind, device, None, strides)
