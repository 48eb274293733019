"""Harmonics of any number of channels are summed three channels at a time."""

import pytest
import torch

from thermosplat.rasterizer.blended_values import grouped, rejoined


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 8])
def test_groups_put_together_again_are_the_signal(channels: int) -> None:
    """Groups have three channels each, the last filled up with zeros; what is filled up is cut off again."""
    coefficients = torch.randn(5, 4, channels)
    groups = grouped("colors", coefficients, 1, torch.zeros(5, 3))
    assert len(groups) == -(-channels // 3)
    assert all(group.values.shape == (5, 4, 3) for group in groups.values())
    summed = rejoined([group.values.sum(1) for group in groups.values()], coefficients)
    torch.testing.assert_close(summed, coefficients.sum(1))


def test_groups_are_named_by_their_channels() -> None:
    """An error about a group says where it lies in what the caller gave."""
    assert list(grouped("colors", torch.zeros(5, 4, 8), 1, torch.zeros(5, 3))) == [
        "colors[..., 0:3]",
        "colors[..., 3:6]",
        "colors[..., 6:8]",
    ]
    assert list(grouped("colors", torch.zeros(5, 4, 3), 1, torch.zeros(5, 3))) == ["colors"]


def test_values_and_what_is_no_tensor_stay_one_group() -> None:
    """Values need no sums; what is wrong is left to the checks."""
    values = torch.zeros(5, 8)
    assert grouped("extra", values, None, torch.zeros(5, 3))["extra"].values is values
    assert list(grouped("colors", "no tensor", 1, torch.zeros(5, 3))) == ["colors"]
