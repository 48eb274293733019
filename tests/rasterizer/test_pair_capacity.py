"""With room enough nothing changes; what does not fit is left out, counted and told."""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from gaussian_scenes import leaves, random_scene
from thermosplat import PairCapacity, UserError, rasterization
from thermosplat.rasterizer.pair_capacity import CALLS, SPARE
from warp_kernels.binning import binning_step


@pytest.fixture(autouse=True, params=[True, False], ids=["compacted", "all"])
def compacted(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every test with the Gaussians that have pairs counted and sorted alone, as of many, and with all sorted."""
    monkeypatch.setattr(binning_step, "COMPACTED", 0 if request.param else 2**18)


def _gradients(inputs: dict) -> dict[str, torch.Tensor]:
    """The gradients on the leaves."""
    found = {name: value.grad for name, value in inputs.items() if isinstance(value, torch.Tensor)}
    return {name: gradient.clone() for name, gradient in found.items() if gradient is not None}


def _measured(scene: dict, device: torch.device) -> tuple[PairCapacity, int]:
    """A capacity that has seen the scene, and its pairs."""
    capacity = PairCapacity(device)
    with capacity.step(fixed=False):
        _, _, info = rasterization(**scene)
    capacity.measure()
    return capacity, len(info["flatten_ids"])


def test_fixed_room_changes_nothing(device: torch.device) -> None:
    """Images and gradients are those of a call that reads its number of pairs back."""
    scene = random_scene(n=300, width=70, height=50)
    inputs = leaves(scene, device, torch.float32)
    capacity, pairs = _measured(inputs, device)
    images, alphas, needed = rasterization(**inputs)
    images.square().sum().backward()
    expected = _gradients(inputs)
    inputs = leaves(scene, device, torch.float32)
    with capacity.step(fixed=True):
        assert capacity.room().pairs == max(1024, round(SPARE * pairs + 0.49))
        fixed_images, fixed_alphas, info = rasterization(**inputs)
    fixed_images.square().sum().backward()
    assert torch.equal(fixed_images, images)
    assert torch.equal(fixed_alphas, alphas)
    for name, gradient in _gradients(inputs).items():
        torch.testing.assert_close(gradient, expected[name], rtol=1e-5, atol=1e-7 * float(expected[name].abs().max()))
    assert info["isect_offsets"].max() <= pairs < len(info["flatten_ids"])
    assert torch.equal(info["isect_ids"], needed["isect_ids"])
    assert capacity.overflow == 0
    assert not capacity.is_short()


def test_pairs_are_noted_before_they_are_listed(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    """So a replay knows early whether they have room."""
    inputs = leaves(random_scene(n=300, width=70, height=50), device, torch.float32)
    _, pairs = _measured(inputs, device)

    def list_pairs(*arrays: object, **options: object) -> None:
        raise RuntimeError("nothing is listed")

    monkeypatch.setattr(binning_step, "list_pairs", list_pairs)
    capacity = PairCapacity(device)
    with pytest.raises(RuntimeError, match="nothing is listed"), capacity.step(fixed=False):
        rasterization(**inputs)
    assert capacity.most.tolist() == [pairs] + [0] * (CALLS - 1)


def test_too_little_room_is_told(device: torch.device) -> None:
    """The nearest pairs are drawn, the rest is missing, nothing is corrupted, and the count says how many."""
    capacity, pairs = _measured(leaves(random_scene(n=20, width=70, height=50), device, torch.float32), device)
    inputs = leaves(random_scene(n=6000, width=70, height=50), device, torch.float32)
    complete, _, info = rasterization(**inputs)
    needed = len(info["flatten_ids"])
    with capacity.step(fixed=True):
        room = capacity.room()
        assert needed > room.pairs >= 1024 > pairs == room.expected_pairs
        image, alphas, _ = rasterization(**inputs)
    image.sum().backward()
    assert all(torch.isfinite(gradient).all() for gradient in _gradients(inputs).values())
    assert capacity.overflow == 1
    assert capacity.is_short()
    with pytest.raises(UserError, match=f"{needed:,} .Gaussian, tile. pairs and room for {room.pairs:,}"):
        capacity.check()
    assert capacity.most[0] == needed
    assert 0 < alphas.mean() < 1
    assert not torch.equal(image, complete)
    capacity.measure()
    capacity.check()
    with capacity.step(fixed=True):
        assert torch.equal(rasterization(**inputs)[0], complete)
    assert capacity.overflow == 0


def test_calls_of_a_step_are_counted_apart() -> None:
    """Each rasterization of a step has a room of its own; outside a step nothing is counted."""
    device = torch.device("cpu")
    capacity = PairCapacity(device)
    with capacity.step(fixed=False):
        counts = [
            len(rasterization(**leaves(random_scene(n=n), device, torch.float32))[2]["flatten_ids"]) for n in (5, 60)
        ]
    rasterization(**leaves(random_scene(n=200), device, torch.float32))
    assert capacity.most[:3].tolist() == [*counts, 0]


def test_no_gaussians_need_no_room(device: torch.device) -> None:
    """An empty scene has no pairs, with a fixed room too."""
    scene = leaves(random_scene(n=4), device, torch.float32)
    empty = {k: v[:0] if k in ("means", "quats", "scales", "opacities", "colors") else v for k, v in scene.items()}
    capacity = PairCapacity(device)
    capacity.measure()
    with capacity.step(fixed=True):
        image, _, _ = rasterization(**{**empty, "backgrounds": None})
    assert image.abs().sum() == 0
    assert capacity.overflow == 0


@pytest.mark.parametrize("name", ["room", "most"])
def test_small_scenes_get_a_least_room(name: str) -> None:
    """A room is never so small that the first bright Gaussian overflows it."""
    capacity = PairCapacity("cpu")
    capacity.measure()
    with capacity.step(fixed=True):
        assert (capacity.room().pairs if name == "room" else int(capacity.most.sum()) + 1024) == 1024


def test_a_room_must_be_measured() -> None:
    """Nobody knows how much a step needs before it was seen."""
    with pytest.raises(UserError, match="nothing was measured") as raised, PairCapacity("cpu").step(fixed=True):
        pass
    assert "measure()" in str(raised.value.hint)


def test_spare_room_is_chosen() -> None:
    """A scene that does not change needs no more than it was seen to need."""
    inputs = leaves(random_scene(n=3000, width=70, height=50), torch.device("cpu"), torch.float32)
    capacity = PairCapacity("cpu", spare=1.0)
    with capacity.step(fixed=False):
        image, _, info = rasterization(**inputs)
    capacity.measure()
    with capacity.step(fixed=True):
        assert capacity.room().pairs == len(info["flatten_ids"]) > 1024
        assert torch.equal(rasterization(**inputs)[0], image)
    capacity.check()


def test_a_step_holds_so_many_rasterizations() -> None:
    """One more is refused, as there is no count for it."""
    inputs = leaves(random_scene(n=4), torch.device("cpu"), torch.float32)
    with PairCapacity("cpu").step(fixed=False):
        for _ in range(CALLS):
            rasterization(**inputs)
        with pytest.raises(UserError, match=f"at most {CALLS} rasterizations"):
            rasterization(**inputs)


def test_threads_do_not_share_a_step() -> None:
    """A render in another thread is none of the step's business."""
    inputs = leaves(random_scene(n=20), torch.device("cpu"), torch.float32)
    capacity = PairCapacity("cpu")
    with capacity.step(fixed=False), ThreadPoolExecutor(1) as pool:
        pool.submit(rasterization, **inputs).result()
    assert capacity.most.sum() == 0


@pytest.mark.parametrize(("more", "short"), [(0, False), (1, True)])
def test_room_to_the_last_pair_is_enough(device: torch.device, more: int, short: bool) -> None:
    """As many pairs as there is room for fit; one more does not."""
    capacity = PairCapacity(device, spare=1.0)
    for fixed, pairs in ((False, 5000), (True, 5000 + more)):
        with capacity.step(fixed=fixed):
            capacity.note(torch.tensor([pairs], device=device))
        if not fixed:
            capacity.measure()
    assert bool(capacity.overflow == 1) is capacity.is_short() is short
