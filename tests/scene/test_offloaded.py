"""Offloaded parameters lie where they belong, go to the host's memory for a while, and come back."""

import pytest
import torch

from thermosplat.scene.offloaded import OffloadedParameter, offload, stored_values
from thermosplat.torch_bridge.host_memory import is_in_host_memory
from thermosplat.torch_bridge.host_rows import has_padded_rows
from toy_scene import toy_capture, toy_config, toy_model


def numbers(device: torch.device) -> torch.Tensor:
    """Rows of 45 numbers."""
    return torch.randn(7, 15, 3, generator=torch.Generator().manual_seed(0)).to(device)


@pytest.mark.parametrize("on_host", [True, False])
def test_there_and_back(device: torch.device, on_host: bool) -> None:
    """It stays the same parameter with the same numbers, and ends where it was."""
    parameter = OffloadedParameter.of(numbers(device), device, on_host=on_host)
    assert has_padded_rows(parameter) == on_host
    parameter.go_to_host()
    assert has_padded_rows(parameter)
    assert torch.equal(parameter, numbers(device))
    address = parameter.data_ptr()
    parameter.go_to_host()
    assert parameter.data_ptr() == address
    parameter.come_back()
    assert has_padded_rows(parameter) == on_host
    assert parameter.is_contiguous() != on_host
    assert torch.equal(parameter, numbers(device))
    assert parameter.requires_grad
    assert is_in_host_memory(parameter) == (on_host or device.type == "cpu")


def test_stays_where_the_device_has_no_room(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    """A parameter that cannot come back keeps its numbers in the host's memory."""

    def full(*args: object, **kwargs: object) -> torch.Tensor:
        raise torch.OutOfMemoryError

    parameter = OffloadedParameter.of(numbers(device), device, on_host=False)
    parameter.go_to_host()
    monkeypatch.setattr(torch.Tensor, "clone", full)
    parameter.come_back()
    monkeypatch.undo()
    assert has_padded_rows(parameter)
    assert torch.equal(parameter, numbers(device))
    parameter.come_back()
    assert not has_padded_rows(parameter)


@pytest.mark.parametrize("parameters", [True, False])
def test_a_set_is_stored_from_where_it_lies(device: torch.device, parameters: bool) -> None:
    """A checkpoint's tensors are ordinary ones, also of a parameter that could not come back."""
    gaussians = toy_model(toy_config(), toy_capture()).gaussians("shared").to(device)
    expected = {name: value.clone() for name, value in gaussians.state_dict().items()}
    offload(gaussians, device, parameters=parameters)
    for name in ("shN", "features"):
        gaussians.get_parameter(name).go_to_host()  # type: ignore[attr-defined]
    stored = stored_values(gaussians)
    assert stored.keys() == expected.keys()
    for name, value in expected.items():
        assert torch.equal(stored[name].cpu(), value.cpu())
        assert stored[name].is_contiguous()
        assert name not in ("shN", "features") or stored[name].device.type == "cpu"
