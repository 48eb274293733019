"""gswarp 1.1.0, a rasterizer in Warp with the interface of 3DGS's own ``diff_gaussian_rasterization``, as a peer.

Its conventions differ from gsplat's: RGB only; Gaussians nearer than 0.2 are not drawn; alpha is clamped at 0.99; tiles
are those within three standard deviations of the larger axis; quaternions must have unit length. Images are [3, H, W].
"""

from collections.abc import Callable
from importlib.metadata import version

import torch
from torch import Tensor

from measuring.agreement import OTHER_CONVENTIONS
from peers.peer import Peer, Rendered, Tensors

NEAR_PLANE = 0.2


def projection_matrix(K: Tensor, width: int, height: int) -> Tensor:
    """OpenGL-like projection [4, 4] whose x / w and y / w run from -1 to 1 over the image, for column vectors.

    3DGS maps them to pixels by ((x / w + 1) · width - 1) / 2: a pixel's centre is at its index, half a pixel left of
    gsplat's, which is the same place in the image. The depth row is not read.

    Args:
        K: [3, 3] intrinsics [px].
        width: image width [px].
        height: image height [px].
    """
    matrix = torch.zeros(4, 4, dtype=K.dtype, device=K.device)
    matrix[0, 0], matrix[0, 2] = 2 * K[0, 0] / width, 2 * K[0, 2] / width - 1
    matrix[1, 1], matrix[1, 2] = 2 * K[1, 1] / height, 2 * K[1, 2] / height - 1
    matrix[2, 2] = matrix[3, 2] = 1.0
    return matrix


def gswarp_peer() -> Peer:
    """gswarp; importing it fails where it is not installed, and it renders on CUDA only."""
    import gswarp

    gswarp.set_compute_depth(False)  # nobody else renders a depth image here

    def renderer(case: str, t: Tensors, width: int, height: int) -> Callable[[], Rendered]:
        view, K = t["viewmats"][0], t["Ks"][0]
        settings = gswarp.GaussianRasterizationSettings(
            image_height=height,
            image_width=width,
            tanfovx=width / (2 * K[0, 0].item()),
            tanfovy=height / (2 * K[1, 1].item()),
            bg=torch.zeros(3, device=view.device),
            scale_modifier=1.0,
            # Matrices are read column by column.
            viewmatrix=view.T.contiguous(),
            projmatrix=(projection_matrix(K, width, height) @ view).T.contiguous(),
            sh_degree=3,
            campos=torch.linalg.inv(view)[:3, 3].contiguous(),
            prefiltered=False,
            auto_tune_verbose=False,
        )
        rasterizer = gswarp.GaussianRasterizer(settings)
        means2d = torch.zeros_like(t["means"])

        def render() -> Rendered:
            color, _, meta = rasterizer(
                means3D=t["means"],
                means2D=means2d,
                opacities=t["opacities"][:, None],
                shs=t["sh"],
                scales=t["scales"],
                rotations=torch.nn.functional.normalize(t["quats"], dim=-1),
            )
            alphas = meta.alpha.reshape(1, height, width, 1)
            return Rendered([color.permute(1, 2, 0)[None], alphas], [])

        return render

    return Peer(
        "gswarp",
        f"gswarp {version('gswarp')}, Warp kernels",
        renderer,
        cases=("rgb",),
        near_plane=NEAR_PLANE,
        tolerance=OTHER_CONVENTIONS,
        release=gswarp.clear_warp_caches,
    )
