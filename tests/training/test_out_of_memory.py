"""Memory errors of torch, Warp and Python are told from others, and the message helps."""

import pytest
import torch
import warp as wp

from thermosplat.training.out_of_memory import is_out_of_memory, out_of_memory_error


def test_torch_allocation_that_fails() -> None:
    """torch's real error on the CPU for more than any machine has."""
    with pytest.raises(RuntimeError) as caught:
        torch.empty(2**60, dtype=torch.uint8)
    assert is_out_of_memory(caught.value)


def test_warp_allocation_that_fails() -> None:
    """Warp's real error on the CPU for more than any machine has."""
    wp.init()
    with pytest.raises(RuntimeError) as caught:
        wp.empty((2**30, 2**18), dtype=wp.float32, device="cpu")
    assert is_out_of_memory(caught.value)


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (torch.OutOfMemoryError("CUDA out of memory."), True),
        (MemoryError(), True),
        (RuntimeError("Failed to allocate 1024 bytes on device 'cuda:0'"), True),
        (RuntimeError("The size of tensor a (3) must match the size of tensor b (4)"), False),
        (ValueError("Failed to allocate a name"), False),
    ],
)
def test_kinds_of_errors(error: Exception, expected: bool) -> None:
    """Only memory errors are taken for memory errors."""
    assert is_out_of_memory(error) == expected


def test_message_names_step_size_and_flags() -> None:
    """The user reads where it happened, what is safe, and three things to do."""
    found = 8412, 3_100_000, "1600x1200", torch.device("cpu"), "Checkpoint saved to a.pt."
    error = out_of_memory_error(*found, "thermosplat-train --resume a")
    assert "step 8,412 with 3,100,000 Gaussians at 1600x1200" in error.message
    assert "Checkpoint saved to a.pt." in error.message
    assert "--data-factor 2" in error.hint
    assert "--densification.max-gaussians 3000000" in error.hint
    assert "thermosplat-train --resume a" in error.hint
    assert "--offload" not in error.hint
    assert "--offload on" in out_of_memory_error(*found, "", can_offload=True).hint
    assert "--densification.max-gaussians 6000000" in out_of_memory_error(*found, "", scenes=2).hint  # for each half
