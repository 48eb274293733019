"""What is offloaded: what was asked for, or as much as is needed; and where it does not work."""

import dataclasses
from typing import Any

import pytest
import torch

from thermosplat.config import DensificationConfig, TrainConfig
from thermosplat.config.checks import check_config
from thermosplat.errors import UserError
from thermosplat.training import offloading
from thermosplat.training.offloading import Decision, decided, refused
from toy_run import toy_run_config
from toy_scene import toy_capture, toy_model

CUDA, CPU = torch.device("cuda"), torch.device("cpu")
MILLION = 1_000_000


def decision(config: TrainConfig, monkeypatch: pytest.MonkeyPatch, free: float = 16e9, host: float = 500e9) -> Decision:
    """What is decided on a GPU with so many bytes free, and so many on the host."""
    monkeypatch.setattr(offloading, "free_device_memory", lambda device, gigabytes: free)
    monkeypatch.setattr(offloading, "host_memory", lambda: host)
    return decided(config, toy_model(config, toy_capture()), CUDA)


def config_of(count: int, *, grows: bool = True, offload: str = "auto", **changes: Any) -> TrainConfig:
    """A training of so many Gaussians of degree 3."""
    densification = DensificationConfig(stop_step=15_000 if grows else 0, max_gaussians=count)
    return toy_run_config(densification=densification, offload=offload, sh_degree=3, **changes)


def test_auto_moves_what_is_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    """68 numbers: a growing Gaussian takes 24 x 68 bytes on the device, with offloading a step's 496 or 24 x 15. In the
    host's memory 53 numbers take as much as 56."""
    assert decision(config_of(7 * MILLION), monkeypatch) == Decision("nothing")  # 11.4 of 12.8 GB
    for count, expected, line in (
        (8 * MILLION, "moments", "8,000,000 Gaussians need 13.1 GB, and 16.0 GB of the GPU are free"),
        (25 * MILLION, "moments", "up to 33.6 GB there, 14.1 GB on the device"),
        (26 * MILLION, "all", "up to 34.9 GB there, 14.1 GB on the device"),
        (80 * MILLION, "all", "80,000,000 Gaussians need 130.6 GB"),  # does not fit either way: as little as can be
    ):
        kind, note, _ = decision(config_of(count), monkeypatch)
        assert kind == expected
        assert note is not None
        assert line in note


@pytest.mark.parametrize(
    ("count", "grows", "share"),
    [
        (8 * MILLION, True, 1.0),  # in steps they all fit
        (16 * MILLION, True, (14.08e9 - 496 * 16e6) / (448 * 16e6)),
        (20 * MILLION, False, (14.08e9 - 496 * 20e6) / (448 * 20e6)),
        (40 * MILLION, True, (14.08e9 - 284 * 40e6) / (448 * 40e6)),  # of kind "all"
        (50 * MILLION, True, 0.0),
    ],
)
def test_auto_keeps_moments_where_there_is_room(
    monkeypatch: pytest.MonkeyPatch, count: int, grows: bool, share: float
) -> None:
    """What 0.88 of the memory leaves beside a step's 496 or 284 bytes is for moments of 448 bytes a Gaussian."""
    _, note, rows = decision(config_of(count, grows=grows), monkeypatch)
    assert note is not None
    if share == 0.0:
        assert rows is None
        assert "between refinements" not in note
    else:
        assert rows == {"shared": pytest.approx(share * count, abs=1)}
        assert f"between refinements those of {share:.0%} of the Gaussians on the device" in note


def test_sets_keep_moments_of_equal_shares(monkeypatch: pytest.MonkeyPatch) -> None:
    """Room is shared by the sets as they share the Gaussians; what was asked for by name keeps none on the device."""
    model = {"gaussian_sets": "separate", "feature_dim": 0}
    _, _, rows = decision(config_of(12 * MILLION, model=model), monkeypatch)
    assert rows is not None
    assert rows["rgb"] == rows["thermal"] > 0
    for kind in ("on", "moments"):
        assert decision(config_of(12 * MILLION, offload=kind), monkeypatch).rows_on_device is None


def test_a_fixed_number_needs_no_copies(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without growth it is the step that counts: 16 x 68 + 44 bytes, 16 x 15 + 4 x 53 + 44 with moments elsewhere."""
    for count, expected in ((11, "nothing"), (12, "moments"), (25, "moments"), (26, "all")):
        config = config_of(60, grows=False)
        config = dataclasses.replace(
            config, densification=dataclasses.replace(config.densification, max_gaussians=count * MILLION)
        )
        assert decision(config, monkeypatch)[0] == expected


def test_a_small_host_keeps_it_on_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the host has no room either, that is said, and nothing is moved."""
    kind, note, _ = decision(config_of(17 * MILLION), monkeypatch, host=40e9)
    assert kind == "nothing"
    assert note is not None
    assert "The host has not the 22.8 GB" in note


@pytest.mark.parametrize(("offload", "expected"), [("on", "all"), ("moments", "moments")])
def test_what_is_asked_for_is_done(monkeypatch: pytest.MonkeyPatch, offload: str, expected: str) -> None:
    """On any device, for any number of Gaussians."""
    kind, note, _ = decision(config_of(100, offload=offload), monkeypatch)
    assert kind == expected
    assert note is not None
    assert note.startswith(f"--offload {offload}. ")
    config = config_of(100, offload=offload)
    assert decided(config, toy_model(config, toy_capture()), CPU)[0] == expected


def test_auto_leaves_the_cpu_alone() -> None:
    """There the device's memory is the host's."""
    config = config_of(80 * MILLION)
    assert decided(config, toy_model(config, toy_capture()), CPU) == Decision("nothing")


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"batch_size": 2}, "--offload works with one frame per step, and --batch-size is 2."),
        ({"feature_norm": 0.1}, "--loss.feature-norm asks for"),
        ({"model": {"feature_dim": 0}, "sh_degree": 0}, "--offload found nothing to offload"),
    ],
)
def test_refusals_are_one_sentence(monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any], sentence: str) -> None:
    """What does not work with offloading is said when it is asked for; by itself it is not chosen."""
    changes = {"offload": "on", "sh_degree": 3, **changes}
    weight = changes.pop("feature_norm", 0.0)
    config = toy_run_config(densification=DensificationConfig(max_gaussians=80 * MILLION), **changes)
    config = dataclasses.replace(config, loss=dataclasses.replace(config.loss, feature_norm=weight))
    with pytest.raises(UserError) as caught:
        decision(config, monkeypatch)
    assert sentence in caught.value.message
    assert caught.value.hint == "Leave --offload out."
    assert decision(dataclasses.replace(config, offload="auto"), monkeypatch) == Decision("nothing")


def test_several_ranks_are_refused() -> None:
    """Gaussians that are divided over ranks stay on their devices."""
    assert refused(config_of(100)) is None
    assert "divided over several" in str(refused(config_of(100), divided=True))


def test_a_memory_limit_is_positive() -> None:
    """--gpu-memory 0 is refused."""
    with pytest.raises(UserError, match="gpu-memory must be positive"):
        check_config(TrainConfig(gpu_memory=0.0))


@pytest.mark.cuda
def test_free_memory_follows_the_limit() -> None:
    """What is free is what the device has, or what the limit leaves."""
    device = torch.device("cuda", torch.cuda.current_device())
    free = offloading.free_device_memory(device, None)
    assert 0 < free <= torch.cuda.get_device_properties(device).total_memory
    held = torch.empty(2**26, device=device)
    assert offloading.free_device_memory(device, 1.0) <= 1e9 - held.numel() * 4
    try:
        offloading.limit_device_memory(device, 1.0)
        with pytest.raises(torch.OutOfMemoryError):
            torch.empty(2**30, device=device)
    finally:
        torch.cuda.set_per_process_memory_fraction(1.0, device)
