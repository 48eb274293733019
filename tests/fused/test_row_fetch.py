"""Rows are fetched as torch selects them."""

import pytest
import torch

from thermosplat.fused.row_fetch import fetched_rows
from thermosplat.torch_bridge.host_rows import in_host_rows
from warp_kernels.training import row_fetch


@pytest.mark.parametrize("at_once", [2**30, 7])
@pytest.mark.parametrize("padded", [True, False])
@pytest.mark.parametrize("used", [0, 3, 8, 15, None])
def test_rows_as_torch_selects_them(
    device: torch.device, used: int | None, padded: bool, at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All coefficients or the first ones, of padded rows and of others; no gradient is recorded."""
    monkeypatch.setattr(row_fetch, "THREADS", at_once)
    values = torch.randn(11, 15, 3, generator=torch.Generator().manual_seed(0)).to(device)
    held = (in_host_rows(values, device) if padded else values.clone()).requires_grad_()
    indices = torch.tensor([0, 3, 4, 10, 3], device=device)
    found = fetched_rows(held, indices, used)
    assert torch.equal(found, values[indices][:, :used])
    assert found.is_contiguous()
    assert not found.requires_grad


def test_no_rows(device: torch.device) -> None:
    """Nothing in view gives an empty tensor."""
    held = in_host_rows(torch.ones(4, 8), device)
    assert fetched_rows(held, torch.zeros(0, dtype=torch.int64, device=device)).shape == (0, 8)
