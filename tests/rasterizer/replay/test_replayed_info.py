"""Entries of ``info`` are differentiable as a plain call's are, and read at any time."""

from typing import Any

import pytest
import torch

from gaussian_scenes import relative_error
from rasterizer_replays import Bench


@pytest.mark.parametrize("key", ["depths", "conics", "opacities"])
def test_losses_on_entries(bench: Bench, key: str) -> None:
    """Beside one on the image, also where the entry was first read without gradients."""
    bench.warmed_up(rasterize_mode="antialiased")
    found = []
    for render in (bench.calls, bench.plain):
        scene = bench.scene(5, rasterize_mode="antialiased")
        image, _, info = render(**scene)
        with torch.no_grad():
            info[key].sum()
        (image.square().sum() + 0.1 * info[key].square().sum()).backward()
        found.append([scene[name].grad for name in ("means", "scales", "opacities", "viewmats")])
    assert bench.calls.counts.replayed == 1
    for ours, theirs in zip(*found, strict=True):
        assert relative_error(ours, theirs) < 1e-4


def test_entries_read_after_the_leaves_changed(bench: Bench) -> None:
    """Values are those of the call; a gradient is refused, as a plain call refuses it."""
    bench.warmed_up()
    values: list[Any] = []
    for render in (bench.calls, bench.plain):
        scene = bench.scene(5)
        info = render(**scene)[-1]
        if render is bench.plain:
            values.append({key: info[key] for key in ("radii", "conics", "depths")})
        with torch.no_grad():
            scene["means"].add_(0.5)
        if render is bench.calls:
            values.append({key: info[key] for key in ("radii", "conics", "depths")})
        with pytest.raises(RuntimeError, match="modified by an inplace operation"):
            info["depths"].sum().backward()
    assert all(torch.equal(values[0][key], values[1][key]) for key in values[0])
    assert bench.calls.counts.replayed == 1


def test_nonfinite_gaussians_are_counted(bench: Bench) -> None:
    """As in a plain call, of the caller's tensors."""
    bench.warmed_up()
    scene = bench.scene(5)
    with torch.no_grad():
        scene["means"][3:5] = torch.nan
    info = bench.calls(**scene)[-1]
    bench.calls(**bench.scene(6))
    assert info["num_nonfinite"] == 2
    assert bench.calls.counts.replayed >= 1


def test_info_is_a_dictionary(bench: Bench) -> None:
    """It copies, and its entries can be replaced."""
    bench.warmed_up()
    info = bench.calls(**bench.scene(5))[-1]
    assert bench.calls.counts.replayed == 1
    copied = dict(info)
    assert copied["radii"].dtype is torch.int32
    assert len(copied["flatten_ids"]) == len(copied["isect_ids"])
    info["radii"] = None
    assert info["radii"] is None
