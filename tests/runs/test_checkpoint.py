"""Checkpoints come back as they were, and a failed write costs nothing."""

import errno
from pathlib import Path
from typing import Any

import pytest
import torch

from thermosplat.errors import UserError
from thermosplat.runs.checkpoint import (
    FORMAT,
    damage_explained,
    load_checkpoint,
    on_host,
    save_checkpoint,
)


def _state() -> dict[str, Any]:
    return {
        "step": 7,
        "config": {"max_steps": 12, "loss": {"features": 1.0}},
        "sh_degree": 1,
        "model": {
            "gaussian_sets": {"shared": {"means": torch.randn(4, 3)}},
            "decoders": None,
            "color_spaces": {"rgb": "photograph", "thermal": "color"},
        },
        "scales": {"thermal": {"kind": "color", "range": (10.0, 30.0), "unit": "celsius"}},
        "training": {"seconds": {"train": 1.5}},
    }


def test_state_comes_back_with_weights_only(tmp_path: Path) -> None:
    """What was saved is what is loaded, tensors and plain values, by torch's safe loader."""
    state = _state()
    save_checkpoint(tmp_path / "ckpts" / "step_000007.pt", state)
    loaded = load_checkpoint(tmp_path / "ckpts" / "step_000007.pt")
    means = loaded["model"]["gaussian_sets"]["shared"].pop("means")
    assert torch.equal(means, state["model"]["gaussian_sets"]["shared"].pop("means"))
    assert loaded == {"format": FORMAT, **state}


def test_full_disk_under_torch_save_is_a_user_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """torch's archive writer wraps the OSError of a full disk; the user still reads the reason."""

    def save(state: object, file: object) -> None:
        try:
            raise OSError(errno.ENOSPC, "No space left on device")
        except OSError:
            raise RuntimeError("unexpected pos 64 vs 0")  # noqa: B904  as torch does

    monkeypatch.setattr(torch, "save", save)
    with pytest.raises(UserError, match="No space left on device"):
        save_checkpoint(tmp_path / "step_000001.pt", _state())


def test_missing_file_is_named(tmp_path: Path) -> None:
    """The path that was looked for is in the message."""
    with pytest.raises(UserError, match=r"No checkpoint at .*absent\.pt"):
        load_checkpoint(tmp_path / "absent.pt")


def test_content_on_the_host_is_of_its_own() -> None:
    """What was gathered for a file stays as it was when training changes tensors, lists and dictionaries."""
    means, groups = torch.ones(2, 3), [{"lr": torch.tensor(0.1), "betas": (0.9, 0.999)}]
    state = {"means": means, "training": {"groups": groups, "step": 7}}
    gathered = on_host(state)
    means.zero_()
    groups[0]["lr"].zero_()
    groups.clear()
    assert torch.equal(gathered["means"], torch.ones(2, 3))
    assert gathered["training"] == {"groups": [{"lr": torch.tensor(0.1), "betas": (0.9, 0.999)}], "step": 7}


@pytest.mark.parametrize("keep", [0, 100, 1500])
def test_damaged_file_is_a_user_error(tmp_path: Path, keep: int) -> None:
    """A file cut off anywhere is reported as damaged."""
    path = tmp_path / "step_000007.pt"
    save_checkpoint(path, _state())
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(UserError, match="damaged or not a thermosplat checkpoint"):
        load_checkpoint(path)


def test_pickled_code_is_refused(tmp_path: Path) -> None:
    """A file with anything but tensors and plain types is not loaded."""
    path = tmp_path / "step_000007.pt"
    torch.save({"format": FORMAT, "model": Path("x")}, path)
    with pytest.raises(UserError, match="damaged or not a thermosplat checkpoint"):
        load_checkpoint(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"state_dict": {}}, "no format number"),
        ({"format": FORMAT + 1}, f"reads format {FORMAT}"),
        ({"format": FORMAT, "step": 3}, "config, sh_degree, model, scales, training missing"),
        ({"format": FORMAT, **_state(), "model": {"x": 1}}, r"model\.gaussian_sets, model\.decoders, .* missing"),
        ({"format": FORMAT, **_state(), "config": None}, "config missing"),
        ({"format": 1, **_state()}, r"thermal_scale, model\.thermal_channels missing"),
        (
            {"format": FORMAT, **_state(), "model": {**_state()["model"], "gaussian_sets": {"shared": {}}}},
            r"model\.gaussian_sets\.shared missing",
        ),
        ({"format": FORMAT, **_state(), "config": {"brightness": 1}}, "unknown key.*Another version of thermosplat"),
    ],
)
def test_foreign_content_is_explained(tmp_path: Path, content: dict[str, Any], message: str) -> None:
    """A torch file that is no checkpoint of this version says why."""
    torch.save(content, tmp_path / "x.pt")
    with pytest.raises(UserError, match=message):
        load_checkpoint(tmp_path / "x.pt")


@pytest.mark.parametrize("error", [KeyError("means"), RuntimeError("size mismatch\nfor weight"), TypeError("no list")])
def test_content_that_cannot_be_used_is_a_user_error(error: Exception) -> None:
    """What an object lacks is said in a sentence; what is one already stays."""
    with pytest.raises(UserError, match=rf"its model cannot be used \({type(error).__name__}: [^\n]*\)"):  # noqa: SIM117
        with damage_explained("model"):
            raise error
    with pytest.raises(UserError, match=r"^mine$"), damage_explained("model"):
        raise UserError("mine")
