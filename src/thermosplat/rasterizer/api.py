"""Differentiable rasterization of 3D Gaussians: gsplat's ``rasterization``.

Conventions are gsplat 1.5.3's: quaternions (w, x, y, z) of any length, world-to-camera view matrices with OpenCV axes,
pixel centres at half-integers. Leading dimensions ``...`` of the Gaussians are scenes; each scene has C cameras.
"""

from typing import Any

import torch
from torch import Tensor

from thermosplat.rasterizer.arguments import check_color_choice, refuse_unsupported
from thermosplat.rasterizer.blended_values import ImageColumns, grouped, rejoined
from thermosplat.rasterizer.call_inputs import (
    CameraModel,
    Cameras,
    Drawn,
    LensArguments,
    RasterizeMode,
    RenderMode,
    Splats,
)
from thermosplat.rasterizer.packed_info import PackedEntries
from thermosplat.rasterizer.ray_blending import blend_along_rays, check_ray_arguments
from thermosplat.rasterizer.render_options import render_options
from thermosplat.rasterizer.replay.replayed_calls import replayed
from thermosplat.rasterizer.scene_of_call import scene_of
from thermosplat.rasterizer.sparse_gradients import check_sparse_gradients, sparse_gradients_of


@replayed
def rasterization(
    means: Tensor,  # [..., N, 3]
    quats: Tensor | None,  # [..., N, 4]
    scales: Tensor | None,  # [..., N, 3]
    opacities: Tensor,  # [..., N]
    colors: Tensor | tuple[Tensor, Tensor] | None,  # [..., (C,) N, D] or [..., (C,) N, K, D]
    viewmats: Tensor,  # [..., C, 4, 4]
    Ks: Tensor,  # [..., C, 3, 3]
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int | None = 16,
    backgrounds: Tensor | None = None,  # [..., C, D]
    render_mode: RenderMode = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: RasterizeMode = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: CameraModel = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,  # [..., N, 3, 3] or [..., N, 6]
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: Any | None = None,
    rolling_shutter: Any | None = None,
    viewmats_rs: Tensor | None = None,
    *,
    return_normals: bool = False,
    global_z_order: bool = True,
    rays: Tensor | None = None,  # [..., C, H, W, 6]
    lidar_coeffs: Any | None = None,
    external_distortion_coeffs: Any | None = None,
    ut_params: Any | None = None,
    extra_signals: Tensor | None = None,  # [..., (C,) N, E] or [..., (C,) N, K, E]
    extra_signals_sh_degree: int | None = None,
    renderer_config: Any | None = None,
    deterministic: bool = False,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Renders Gaussians with any number of channels; gsplat's ``rasterization`` in names and meaning.

    Differentiable, once, in means, quats, scales, opacities, colors, covars, viewmats, backgrounds and (unlike gsplat)
    Ks, viewmats_rs and the coefficients of lenses: for second derivatives torch raises, or, of a loss linear in the
    image, takes gradients for constants. On the CPU and on CUDA, in float32 or float64; all tensors have the dtype and
    device of ``means``. A Gaussian with anything non-finite is invisible and counted in ``info["num_nonfinite"]``;
    before a non-finite camera all of them are.

    Not supported, and only there for gsplat's signature: lidar_coeffs, external_distortion_coeffs, other ut_params than
    gsplat's defaults. A renderer_config changes nothing.

    Args:
        means: Centres, [..., N, 3], world units.
        quats: Rotations (w, x, y, z) of any length, [..., N, 4]. Ignored (may be None) when ``covars`` is given.
        scales: Standard deviations along the Gaussian's axes, [..., N, 3], world units. Ignored with ``covars``.
        opacities: In [0, 1], [..., N].
        colors: Features [..., N, D] or per camera [..., C, N, D]; with ``sh_degree``, coefficients [..., N, K, D] or
            [..., C, N, K, D] with K at least (sh_degree + 1)². Three channels are the fastest. [N, K, D] are those of
            all scenes, and coefficients may have 16 bits. Stored apart, as 3DGS does, they need not be joined: a pair
            of the first coefficient [..., (C,) N, 1, 3] and the others [..., (C,) N, K - 1, 3]. None where
            ``render_mode`` shows no colours.
        viewmats: World-to-camera, OpenCV axes, [..., C, 4, 4].
        Ks: Intrinsics, [..., C, 3, 3], px.
        width: Image width [px], at most 2²⁴.
        height: Image height [px], at most 2²⁴.
        near_plane: Gaussians nearer than this are not drawn [world units].
        far_plane: Gaussians farther than this are not drawn [world units].
        radius_clip: Gaussians whose radii are both at most this are not drawn [px].
        eps2d: Added to the diagonal of the 2D covariance [px²].
        sh_degree: Active degree, 0 to 4; None: ``colors`` are final values.
        packed: Images are the same. True: the entries of ``info`` have one row for each Gaussian that a camera sees,
            [nnz], as gsplat's packed mode has them, and say which Gaussian it is; picked when they are read. False:
            they have all of them, [..., C, N].
        tile_size: 8, 16 (also None) or 32 [px]; changes speed only.
        backgrounds: Colours behind everything, [..., C, D], or [..., C, D + E] behind the extra signals too; finite,
            which is checked on the CPU alone, as a CUDA device would have to be waited for.
        render_mode: "RGB", "D" (accumulated depth), "ED" (expected depth), "RGB+D" or "RGB+ED"; with ``with_eval3d``
            also "d", "Ed", "RGB-d" and "RGB-Ed": the distance along the ray to where it meets the Gaussian.
        sparse_grad: Gradients of means, quats, scales and covars are sparse tensors with the rows of the Gaussians that
            were drawn, for optimizers such as ``torch.optim.SparseAdam``. As in gsplat it needs ``packed=True`` and no
            leading dimensions.
        absgrad: Sums of a traversal's absolute per-pixel gradients add up in ``info["means2d"].absgrad`` like .grad.
        rasterize_mode: "classic", or "antialiased": opacities are scaled by what ``eps2d`` adds to the area
            (Mip-Splatting).
        channel_chunk: At most so many channels are blended in one traversal (never more than 32).
        distributed: Each rank of ``torch.distributed`` gives its share of the Gaussians and its own cameras, and gets
            its own images of all Gaussians (docs/several-devices.md). Gradients reach the Gaussians and cameras of the
            other ranks. Every rank makes the same calls, backward too, with the same options; the number of cameras
            (none is a number too), their models and lenses, and the images' size may differ. ``colors`` for each
            camera are for those of all ranks.
        camera_model: "pinhole", "ortho", "fisheye" or "ftheta". Formulas and what is not drawn: docs/conventions.md.
        with_ut: Projects pinhole and orthographic cameras by the unscented transform too, as all lenses are.
        radial_coeffs: k1 to k6 of OpenCV's rational model, [..., C, 6], or k1 to k4, [..., C, 4]; of a fisheye camera
            k1 to k4 of OpenCV's fisheye model, [..., C, 4].
        tangential_coeffs: p1 and p2 of a pinhole camera, [..., C, 2].
        thin_prism_coeffs: s1 to s4 of a pinhole camera, [..., C, 4].
        ftheta_coeffs: An ``FThetaCameraDistortionParameters`` for all cameras, ours or gsplat's.
        rolling_shutter: A ``RollingShutterType``, ours or gsplat's: how lines are read out, one after the other.
        viewmats_rs: Poses when the last line is read, [..., C, 4, 4]; ``viewmats`` are those of the first.
        covars: Symmetric covariances, [..., N, 3, 3], world units², of which only the upper triangle is read; or that,
            [..., N, 6].
        segmented: Accepted for gsplat's sake: how gsplat sorts; the result is the same.
        with_eval3d: Blend by the Gaussians' response along rays in three dimensions instead of in the image (3DGUT).
            The projection still gives order and tiles. Not with absgrad, covars, sparse_grad, distributed, the
            antialiased mode, and on CUDA deterministic. Not tuned: one thread has a pixel.
        return_normals: Blend the Gaussians' third axes, turned towards the camera, into ``info["normals"]``
            [..., C, H, W, 3]; needs ``with_eval3d``.
        rays: Origin and direction of each pixel's ray in the world, [..., C, H, W, 6], of any camera; None: those of
            ``viewmats`` and ``Ks``. Differentiable. Needs ``with_eval3d``.
        global_z_order: True: Gaussians are sorted by the camera's z axis. False: by their distance from the camera's
            centre, which is then the depth in ``render_mode``, too. gsplat asks for ``with_ut`` with it.
        extra_signals: Further channels [..., N, E] or [..., C, N, E]; with ``extra_signals_sh_degree`` coefficients
            [..., (C,) N, K, E], whose sums are not clamped at 0. Their image is ``info["render_extra_signals"]``.
        extra_signals_sh_degree: Active degree of the extra signals, 0 to 4; None: they are final values.
        deterministic: Gradients are the same to the bit on every run, also on CUDA, where that takes more memory (a
            record of D + 6 numbers for each pair of a Gaussian and a part of a tile) and time. On the CPU always so.

    Returns:
        ``(render_colors, render_alphas, info)``: images [..., C, H, W, X] with X = D, 1 or D + 1; accumulated
        opacities [..., C, H, W, 1]; gsplat's dictionary, parts of which are computed when they are read. Its keys:
        visible bool [..., C, N], which Gaussians are drawn; 0 where they are not: means2d [..., C, N, 2] px, radii
        int32 [..., C, N, 2] px, depths [..., C, N], conics [..., C, N, 3] 1/px²; opacities [..., C, N] as drawn,
        tiles_per_gauss int32 [..., C, N]; of the sorted (Gaussian, tile) pairs flatten_ids int32 [pairs], isect_ids
        int64 [pairs], and isect_offsets int32 [..., C, tile_height, tile_width], the first pair of each tile; the
        numbers width, height, tile_size, tile_width, tile_height, n_batches, n_cameras and num_nonfinite; with
        ``extra_signals`` their image, render_extra_signals [..., C, H, W, E]; with ``return_normals`` normals; and
        batch_ids, camera_ids and gaussian_ids, which are None. With ``packed`` these are int64 [nnz], and means2d to
        tiles_per_gauss have [nnz] in the place of [..., C, N], which flatten_ids then counts.

    Raises:
        UserError: if an argument has the wrong shape, type or device, or asks for what is not supported.

    Example:
        >>> import torch
        >>> from thermosplat import rasterization
        >>> n = 100
        >>> colors, alphas, info = rasterization(
        ...     means=torch.randn(n, 3), quats=torch.randn(n, 4), scales=0.1 * torch.rand(n, 3),
        ...     opacities=torch.rand(n), colors=torch.rand(n, 3),
        ...     viewmats=torch.eye(4)[None], Ks=torch.tensor([[[300.0, 0, 150], [0, 300, 100], [0, 0, 1]]]),
        ...     width=300, height=200)
        >>> colors.shape, alphas.shape
        (torch.Size([1, 200, 300, 3]), torch.Size([1, 200, 300, 1]))
    """
    if not (lidar_coeffs is external_distortion_coeffs is ut_params is renderer_config is None):
        refuse_unsupported(
            lidar_coeffs=lidar_coeffs,
            external_distortion_coeffs=external_distortion_coeffs,
            ut_params=ut_params,
            renderer_config=renderer_config,
        )
    options = render_options(render_mode, sh_degree, extra_signals_sh_degree, channel_chunk)
    check_color_choice(colors, options.sh_degree, render_mode)
    coefficients = (radial_coeffs, tangential_coeffs, thin_prism_coeffs, ftheta_coeffs)
    lens = LensArguments(with_ut, *coefficients, rolling_shutter, viewmats_rs)
    if with_eval3d or options.hits or return_normals or rays is not None:
        check_ray_arguments(
            with_eval3d,
            needs={
                f"render_mode={render_mode!r}": options.hits,
                "return_normals": return_normals,
                "rays": rays is not None,
            },
            excludes={
                "absgrad": absgrad,
                "covars": covars is not None,
                "distributed": distributed,
                "sparse_grad": sparse_grad,
                "rasterize_mode='antialiased'": rasterize_mode == "antialiased",
                "a lens or a rolling shutter without rays": rays is None and lens.is_asked_for(camera_model),
                "deterministic": deterministic and getattr(means, "is_cuda", False),
            },
        )
    values = grouped("colors", colors, options.sh_degree, means) if options.colors else {}
    color_groups = len(values)
    if extra_signals is not None:
        values |= grouped("extra_signals", extra_signals, options.extra_signals_sh_degree, means, clamped=False)
    splats = Splats(means, quats, scales, opacities, covars)
    if sparse_grad:
        check_sparse_gradients(means, packed=packed, distributed=distributed)
        visible: list[Tensor] = []
        splats = sparse_gradients_of(splats, visible=visible)
    cameras = Cameras(viewmats, Ks, width, height, near_plane, far_plane, camera_model, lens)
    tile_size = 16 if tile_size is None else tile_size
    how = (radius_clip, eps2d, tile_size, rasterize_mode, deterministic, global_z_order, distributed)
    scene = scene_of(splats, cameras, Drawn(values, *how))
    if sparse_grad:
        visible.append(scene.projected.visible.any(0))
    depths = scene.depths.reshape(-1, 1) if options.depths else None
    weights = torch.ones_like(scene.depths).reshape(-1, 1) if options.weights else None
    columns = ImageColumns(
        rejoined(scene.features[:color_groups], colors) if color_groups else None,
        rejoined(scene.features[color_groups:], extra_signals) if extra_signals is not None else None,
        depths,
        weights,
    )
    behind = None
    if backgrounds is not None:
        given = colors[0] if isinstance(colors, tuple) else colors
        behind = columns.behind(backgrounds, means, scene.settings.num_cameras, 0 if given is None else given.shape[-1])
    along: Any = None
    if with_eval3d:
        features = columns.features
        along = blend_along_rays(
            scene, splats, cameras, features, options.chunk, rays=rays, hits=options.hits, normals=return_normals
        )
        render, transmittance, alphas = along.render, along.transmittance, 1.0 - along.transmittance
    else:
        blended = scene.blend_in_chunks(columns.features, options.chunk, absgrad)
        render, transmittance, alphas = blended.render, blended.transmittance, blended.alphas
    if behind is not None:
        render = torch.addcmul(render, transmittance, behind[..., None, None, :])
    distances = along.hits if options.hits else None
    render_colors, render_extra_signals = columns.split_image(render, expected=options.expected, hits=distances)
    info = scene.info()
    if packed:
        info.entries = PackedEntries(info.entries)
    if return_normals:
        info["normals"] = along.normals
    if render_extra_signals is not None:
        info["render_extra_signals"] = render_extra_signals
    return render_colors, alphas, info
