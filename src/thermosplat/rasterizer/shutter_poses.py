"""The two poses of a rolling shutter as one motion, for torch; see warp_kernels' motion_step."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from thermosplat.torch_bridge.arrays import kinds_of, vector_of, view
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.projection.motion_step import make_motions, make_motions_adjoint
from warp_kernels.projection.shutter_motion import MOTION


def motions(viewmats: Tensor, viewmats_rs: Tensor) -> tuple[Tensor, Tensor]:
    """Motions as warp_kernels' shutter_motion has them; differentiable in both poses.

    Args:
        viewmats: Poses at the beginning of the readout, [..., C, 4, 4].
        viewmats_rs: Poses at its end, less than half a turn away, [..., C, 4, 4].

    Returns:
        Motions [..., C, MOTION], and view matrices from half way between the two camera positions, [..., C, 4, 4].
    """
    made: tuple[Tensor, Tensor] = _Motions.apply(viewmats, viewmats_rs)
    return made


class _Motions(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, viewmats: Tensor, viewmats_rs: Tensor) -> tuple[Tensor, Tensor]:
        begin, end = viewmats.contiguous(), viewmats_rs.contiguous()
        made, half_way = begin.new_empty(*begin.shape[:-2], MOTION), torch.empty_like(begin)
        mat44 = kinds_of(begin.dtype).mat44
        count = made.numel() // MOTION
        with launches_on_torch_stream(begin.device):
            make_motions(
                view(begin, mat44, count),
                view(end, mat44, count),
                view(made, vector_of(MOTION, begin.dtype)),
                view(half_way, mat44, count),
            )
        ctx.save_for_backward(begin, end)
        ctx.set_materialize_grads(False)
        return made, half_way

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_motions: Tensor | None, v_half_way: Tensor | None) -> tuple[Tensor, Tensor]:
        begin, end = ctx.saved_tensors
        v_begin, v_end = torch.empty_like(begin), torch.empty_like(end)
        mat44, motion = kinds_of(begin.dtype).mat44, vector_of(MOTION, begin.dtype)
        count = begin.numel() // 16
        v_motions = None if v_motions is None else v_motions.contiguous()
        v_half_way = None if v_half_way is None else v_half_way.contiguous()
        with launches_on_torch_stream(begin.device):
            make_motions_adjoint(
                view(begin, mat44, count),
                view(end, mat44, count),
                None if v_motions is None else view(v_motions, motion),
                None if v_half_way is None else view(v_half_way, mat44, count),
                view(v_begin, mat44, count),
                view(v_end, mat44, count),
            )
        return v_begin, v_end
