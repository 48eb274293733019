"""What is made of a profile: groups of kernels, idle time, the order of a step, and tables beside one device."""

from dataclasses import asdict

import pytest
import torch

from measuring.kernel_profile import Span, StepProfile, Stretch, profiled_step, summed
from measuring.profile_tables import NOTHING, profile_tables
from training.step_parts import finer_part_of

GROUPS = {"blend_forward": "blending", "ncclDevKernel_SendRecv": "NCCL", "fill": "fills"}


def two_steps() -> list[Span]:
    """In each step 3 ms of blending, 1 ms of nothing, and 2 ms of exchange, of which half a fill runs beside."""
    found = []
    for start in (0.0, 10_000.0):
        found += [
            Span("fill", start + 4_000.0, start + 5_000.0),
            Span("ncclDevKernel_SendRecv", start + 4_000.0, start + 6_000.0),
            Span("blend_forward", start, start + 3_000.0),
        ]
    return found


def test_time_of_a_step_by_group() -> None:
    """Kernels count each, busy time counts what runs at the same time once, and the rest of the step is idle."""
    profile = summed(two_steps(), 2, 0.020, GROUPS.__getitem__)
    assert profile.groups == pytest.approx({"blending": 3.0, "NCCL": 2.0, "fills": 1.0})
    assert (profile.wall_ms, profile.busy_ms, profile.idle_ms) == pytest.approx((10.0, 5.0, 5.0))
    assert profile.exchange_alone_ms == pytest.approx(1.0)
    assert [(kernel.name, kernel.calls) for kernel in profile.kernels] == [
        ("blend_forward", 1.0),
        ("ncclDevKernel_SendRecv", 1.0),
        ("fill", 1.0),
    ]


def test_the_order_of_a_step() -> None:
    """Neighbours of one group are one line, with the idle time before them; steps that differ have no order."""
    spans = [*two_steps(), Span("blend_forward", 1_000.0, 1_500.0), Span("blend_forward", 13_000.0, 13_500.0)]
    order = summed(spans, 2, 0.020, GROUPS.__getitem__).order
    assert order[0] == pytest.approx(Stretch(0.0, "blending", 3.5, 2, 0.0))
    assert [stretch.group for stretch in order] == ["blending", "fills", "NCCL"]
    assert [stretch.idle_ms for stretch in order] == pytest.approx([0.0, 0.5, 0.0])
    assert summed(spans[1:], 2, 0.020, GROUPS.__getitem__).order == []


def test_tables_set_ranks_beside_one_device() -> None:
    """The most of a rank minus the share of one device that does all; a profile comes back from JSON as it was."""
    alone = summed([Span("blend_forward", 0.0, 4_000.0)], 1, 0.004, GROUPS.__getitem__)
    ranks = [summed(two_steps(), 2, 0.020, GROUPS.__getitem__) for _ in range(2)]
    assert StepProfile.of(asdict(ranks[0])) == ranks[0]
    table = profile_tables("two", ranks, alone)
    assert "| blending | 3.000 | 3.000 | 2.000 | +1.000 |" in table
    assert "| *idle* | 5.000 | 5.000 | 0.000 | +5.000 |" in table
    assert "| `blend_forward` | blending | 1 | 3.000 | 1, 2.000 |" in table
    assert "| 4.000 | NCCL | 1 | 2.000 | 0.000 |" in table


def test_a_profile_without_kernels_says_so() -> None:
    """Nothing is divided by nothing, and one line tells."""
    nothing = summed([], 2, 0.020, GROUPS.__getitem__)
    assert (nothing.busy_ms, nothing.idle_ms, nothing.order) == (0.0, 10.0, [])
    assert NOTHING in profile_tables("none", [nothing])


def test_kernels_of_torch_are_told_apart() -> None:
    """Sums over rows, copies, fills and exchanges of torch have parts of their own; ours keep theirs."""
    assert finer_part_of("ncclDevKernel_SendRecv(ncclDevKernelArgsStorage<4096ul>)") == "NCCL"
    assert finer_part_of("gather_rows_float32_ab12_cuda_kernel_forward") == "rows for ranks"
    assert finer_part_of("void at_cuda_detail::cub::DeviceScanKernel<long>") == "sums in a row (torch)"
    assert finer_part_of("void cub::DeviceScanKernel<int>") == "binning"
    assert finer_part_of("Memcpy DtoD (Device -> Device)") == "copies"
    assert finer_part_of("void at::native::vectorized_elementwise_kernel<4, at::native::FillFunctor<float>>") == "fills"
    assert finer_part_of("void at::native::reduce_kernel<512, 1>") == "sums (torch)"
    assert finer_part_of("blend_adjoint_11_8_float32_8x4_ab12_cuda_kernel_forward") == "blending adjoint"
    assert finer_part_of("stranger") == "rest"


@pytest.mark.cuda
def test_kernels_of_a_recorded_step_are_seen() -> None:
    """Each kernel of a CUDA graph counts, once for each replay; steps before those that count do not."""
    device = torch.device("cuda", 0)
    numbers, graph = torch.zeros(2**20, device=device), torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        numbers.add_(1.0)
        numbers.mul_(0.5)
    profile = profiled_step(graph.replay, 5, device, finer_part_of)
    assert sum(kernel.calls for kernel in profile.kernels) == 2
    assert 0 < profile.busy_ms < profile.wall_ms
    assert sum(stretch.kernels for stretch in profile.order) == 2
