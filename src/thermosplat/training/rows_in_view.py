"""How gradients of the Gaussians in view come back where some of a set is offloaded.

A step renders the Gaussians in view alone (``scene.gaussians_in_view``). Gradients of what lies on the device come back
by autograd; fetched rows are handed to the optimizers that update them in the host's memory; what density control looks
at is brought to the order of all Gaussians.
"""

from types import SimpleNamespace
from typing import Any

from torch import Tensor

from thermosplat.fused.row_adam import RowAdam, Rows
from thermosplat.scene.offloaded import GaussiansInView
from thermosplat.scene.rendered_frame import RenderedFrame
from thermosplat.training.density.gaussian_ops import Optimizers


def hand_rows_over(rendered: RenderedFrame, optimizers: dict[str, Optimizers]) -> None:
    """Tell optimizers of offloaded parameters which rows the frame has used.

    Args:
        optimizers: By name of the set, and of the parameter.
    """
    for owner, gaussians in rendered.in_view.items():
        if owner not in rendered.infos:
            continue
        for name, values in gaussians.rows.items():
            optimizer = optimizers[owner][name]
            if isinstance(optimizer, RowAdam) and (values.grad is not None or values.numel() == 0):
                optimizer.rows = Rows(gaussians.indices, values)


def observed_in_order(rendered: RenderedFrame, numbers: dict[str, int]) -> dict[str, list[dict[str, Any]]]:
    """What density control looks at of a frame, as if all Gaussians had been rendered."""
    return {
        name: [_in_order(info, rendered.in_view[name], numbers[name]) for info in infos]
        if name in rendered.in_view
        else infos
        for name, infos in rendered.infos.items()
    }


def _in_order(info: dict[str, Any], gaussians: GaussiansInView, number: int) -> dict[str, Any]:
    """A call's info of all Gaussians; those out of view are not visible and have no gradient. As it is, where density
    control has not asked for the gradient: then it looks at nothing."""
    means2d = info["means2d"]
    if not means2d.retains_grad:
        return info

    def spread(values: Tensor | None) -> Tensor | None:  # [C, n, ...] to [C, N, ...]
        if values is None:
            return None
        return values.new_zeros(len(values), number, *values.shape[2:]).index_copy_(1, gaussians.indices, values)

    gradients = SimpleNamespace(grad=spread(means2d.grad), absgrad=spread(getattr(means2d, "absgrad", None)))
    kept = {key: info[key] for key in ("width", "height", "n_cameras", "spectra")}
    return {**kept, "means2d": gradients, "visible": spread(info["visible"])}
