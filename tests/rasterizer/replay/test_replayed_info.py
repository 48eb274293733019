"""Entries of ``info`` are differentiable as a plain call's are, and read at any time."""

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
import torch

from gaussian_scenes import relative_error
from rasterizer_replays import SEEN, Bench


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


def test_packed_rows_of_a_replay(bench: Bench) -> None:
    """Values and retained gradients are those of the plain call's rows."""
    bench.warmed_up(packed=True)
    found = []
    for render in (bench.calls, bench.plain):
        image, _, packed = render(**bench.scene(5, packed=True))
        packed["means2d"].retain_grad()
        image.square().sum().backward()
        found.append([packed["gaussian_ids"], packed["radii"], packed["means2d"], packed["means2d"].grad])
    assert bench.calls.counts.replayed == 1
    assert torch.equal(found[0][0], found[1][0])
    assert torch.equal(found[0][1], found[1][1])
    for ours, theirs in zip(found[0][2:], found[1][2:], strict=True):
        assert relative_error(ours.detach(), theirs.detach()) < 1e-5


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


def test_opacities_are_the_callers(either_bench: Bench) -> None:
    """As in a plain call: not copied, so that they change with them; copied where they are another tensor."""
    either_bench.warmed_up()
    for render in (either_bench.calls, either_bench.plain):
        scene = either_bench.scene(5)
        info = render(**scene)[-1]
        keys = [key for key in info if key.endswith("opacities")]
        assert len(keys) == 1 + either_bench.rgbt
        for key in keys:
            assert info[key].data_ptr() == scene[key].data_ptr()
        with torch.no_grad():
            scene["opacities"].mul_(0.5)
            assert torch.equal(info["opacities"][0], scene["opacities"])
    of_two = either_bench.scene(5, cameras=2)
    for _ in range(SEEN + 1):
        info = either_bench.calls(**of_two)[-1]
        info["means2d"].sum().backward()
    assert info["opacities"].shape == (2, 50)
    assert torch.equal(info["opacities"][1], of_two["opacities"])
    assert either_bench.calls.counts.replayed == 2


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


@pytest.mark.parametrize("with_gradients", [True, False])
def test_entries_read_after_later_calls(either_bench: Bench, with_gradients: bool) -> None:
    """Each info has its own call's values, whenever it is read, and whichever is read first."""
    with torch.set_grad_enabled(with_gradients):
        for seed in range(SEEN):
            either_bench.calls(**either_bench.scene(seed))
        scenes = [either_bench.scene(seed) for seed in range(10, 14)]
        infos = []
        for scene in scenes:
            result = either_bench.calls(**scene)
            if with_gradients:
                result[0].sum().backward()
            infos.append(result[-1])
        assert either_bench.calls.counts.replayed == len(scenes)
        for k in (1, 3, 0, 2):
            truth = either_bench.plain(**scenes[k])[-1]
            for key in ("means2d", "radii", "depths", "conics", "isect_ids", "tiles_per_gauss"):
                assert torch.equal(infos[k][key], truth[key]), key


def test_threads_read_while_others_render(bench: Bench) -> None:
    """A reader gets its call's values, though the next replay writes where they lie."""
    scenes = [bench.scene(seed) for seed in range(40)]
    with torch.no_grad():
        for scene in scenes[:SEEN]:
            bench.calls(**scene)
        truths = [bench.plain(**scene)[-1]["depths"] for scene in scenes]
        with ThreadPoolExecutor(3) as pool:
            read = [pool.submit(lambda info: info["depths"], bench.calls(**scene)[-1]) for scene in scenes]
            assert all(torch.equal(one.result(), truth) for one, truth in zip(read, truths, strict=True))
    assert bench.calls.counts.replayed == len(scenes)


@pytest.mark.cuda
def test_entries_read_on_another_stream() -> None:
    """Its work comes after the copy, and the next replay after that."""
    bench = Bench(torch.device("cuda"))
    scenes = [bench.scene(seed, n=5000) for seed in range(SEEN + 6)]
    other = torch.cuda.Stream()
    with torch.no_grad():
        truths = [bench.plain(**scene)[-1]["depths"].clone() for scene in scenes]
        for scene in scenes[:SEEN]:
            bench.calls(**scene)
        for scene, truth in zip(scenes[SEEN:], truths[SEEN:], strict=True):
            info = bench.calls(**scene)[-1]
            other.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(other):
                torch.cuda._sleep(1_000_000)
                doubled = 2.0 * info["depths"]
            del info
            bench.calls(**scenes[0])
            other.synchronize()
            assert torch.equal(doubled, 2.0 * truth)
    assert bench.calls.counts.replayed == 12


@pytest.mark.cuda
def test_first_read_inside_a_capture_is_refused() -> None:
    """A copy would be recorded in place of being made."""
    bench = Bench(torch.device("cuda"))
    with torch.no_grad():
        for seed in range(SEEN + 1):
            info = bench.calls(**bench.scene(seed))[-1]
        torch.cuda.synchronize()
        with pytest.raises(RuntimeError, match="read for the first time"), torch.cuda.graph(torch.cuda.CUDAGraph()):
            info["radii"]
        torch.cuda.synchronize()
        assert info["radii"].shape[-1] == 2


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
