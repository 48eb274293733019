"""gsplat's ``fully_fused_projection``."""

from torch import Tensor

from thermosplat.rasterizer.call_inputs import CameraModel, Cameras, Drawn, RasterizeMode, Splats
from thermosplat.rasterizer.graph_breaks import not_compiled
from thermosplat.rasterizer.info import clear_unseen, radii_of
from thermosplat.rasterizer.info import conics as conics_of
from thermosplat.rasterizer.packed_info import PackedRows
from thermosplat.rasterizer.scene_of_call import scene_of
from thermosplat.rasterizer.sparse_gradients import check_sparse_gradients, sparse_gradients_of

UNBOUNDED = 1e30
"""An opacity at which every Gaussian has gsplat's largest extent, 3.33 standard deviations, whatever scales it."""


@not_compiled
def fully_fused_projection(
    means: Tensor,  # [..., N, 3]
    covars: Tensor | None,  # [..., N, 6] or [..., N, 3, 3]
    quats: Tensor | None,  # [..., N, 4]
    scales: Tensor | None,  # [..., N, 3]
    viewmats: Tensor,  # [..., C, 4, 4]
    Ks: Tensor,  # [..., C, 3, 3]
    width: int,
    height: int,
    eps2d: float = 0.3,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    packed: bool = False,
    sparse_grad: bool = False,
    calc_compensations: bool = False,
    camera_model: CameraModel = "pinhole",
    opacities: Tensor | None = None,  # [..., N]
) -> tuple[Tensor | None, ...]:
    """Projects Gaussians to the image planes of cameras; gsplat's function.

    Differentiable in means, covars, quats, scales, viewmats and, unlike gsplat, Ks.

    Args:
        means: Centres, [..., N, 3], world units.
        covars: Upper triangles xx, xy, xz, yy, yz, zz, [..., N, 6], or symmetric matrices [..., N, 3, 3], world units²;
            None: quats and scales are given.
        quats: Rotations (w, x, y, z), [..., N, 4].
        scales: Standard deviations, [..., N, 3], world units.
        viewmats: World to camera, [..., C, 4, 4].
        Ks: Intrinsics, [..., C, 3, 3], px.
        width: Of the image [px].
        height: Of the image [px].
        eps2d: Added to the diagonal of the 2D covariance [px²].
        near_plane: Gaussians nearer than this are culled [world units].
        far_plane: Gaussians farther than this are culled [world units].
        radius_clip: Gaussians whose radii are both at most this are culled [px].
        packed: Return what is visible only, as flat tensors.
        sparse_grad: With ``packed``: sparse gradients, as in ``rasterization``.
        calc_compensations: Return the factor of opacities in the antialiased mode, too.
        camera_model: As in ``rasterization``.
        opacities: In [0, 1], [..., N]: radii end where alpha falls below 1/255. None: at 3.33 standard deviations.

    Returns:
        ``(radii, means2d, depths, conics, compensations)``: int32 [..., C, N, 2] px, 0 where culled; [..., C, N, 2] px;
        [..., C, N]; [..., C, N, 3] 1/px²; [..., C, N] or None. With ``packed``, as in gsplat 1.5.3, ``(batch_ids,
        camera_ids, gaussian_ids)``, int64 [nnz], and then these with [nnz] in the place of [..., C, N].

    Raises:
        UserError: an argument has the wrong shape, type or device.
    """
    if opacities is None and isinstance(means, Tensor):
        opacities = means.new_full(means.shape[:-1], UNBOUNDED)
    splats = Splats(means, quats, scales, opacities, covars)
    if sparse_grad:
        check_sparse_gradients(means, packed=packed, distributed=False)
        visible: list[Tensor] = []
        splats = sparse_gradients_of(splats, visible=visible)
    cameras = Cameras(viewmats, Ks, width, height, near_plane, far_plane, camera_model)
    mode: RasterizeMode = "antialiased" if calc_compensations else "classic"
    scene = scene_of(splats, cameras, Drawn({}, radius_clip, eps2d, rasterize_mode=mode))
    drawn, compensations = scene.projected.visible, scene.projected.compensations
    if sparse_grad:
        visible.append(drawn.any(0))
    radii = radii_of(scene.projected.extents, drawn)
    conics = conics_of(scene.projected.roots, drawn)
    for tensor in (scene.means2d, scene.depths):
        clear_unseen(tensor, drawn)
    if not packed:
        return radii, scene.means2d, scene.depths, conics, compensations
    rows = PackedRows(drawn)
    picked = [rows.of(one) for one in (radii, scene.means2d, scene.depths, conics)]
    return *rows.ids, *picked, None if compensations is None else rows.of(compensations)
