"""Device flags are read, and refused where there is no such device."""

import pytest
import torch

from thermosplat.errors import UserError
from thermosplat.runs.devices import choose_device, device_name


def test_auto_takes_cuda_where_there_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """ "auto" is the GPU if torch has one, else the CPU."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert choose_device("auto") == torch.device("cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 1)
    assert choose_device("auto") == torch.device("cuda", 1)


@pytest.mark.parametrize(
    ("name", "message"),
    [("gpu", '--device must be "auto"'), ("meta", "is not supported"), ("cuda", "torch finds no CUDA device")],
)
def test_impossible_devices_are_explained(monkeypatch: pytest.MonkeyPatch, name: str, message: str) -> None:
    """A device that is not there, or not one of ours, is an error that says so."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(UserError, match=message):
        choose_device(name)


def test_index_beyond_the_last_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """cuda:3 on a machine with two devices names the last one."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    with pytest.raises(UserError, match="the last CUDA device here is cuda:1"):
        choose_device("cuda:3")
    assert choose_device("cuda:1") == torch.device("cuda", 1)


def test_cpu_name_counts_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports say how many threads a CPU number was made with."""
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    assert device_name(torch.device("cpu")) == "CPU, 2 threads"
