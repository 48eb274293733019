"""Checkpoint files come back as they were; damaged ones, and those from strangers, end in a sentence."""

import errno
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from thermosplat.config import TrainConfig
from thermosplat.config.files import to_dict
from thermosplat.errors import UserError
from thermosplat.runs.checkpoint import FORMAT
from thermosplat.runs.checkpoint_file import load_checkpoint, on_host, save_checkpoint


def _state() -> dict[str, Any]:
    return {
        "step": 7,
        "config": to_dict(TrainConfig(max_steps=12)),
        "sh_degree": 1,
        "model": {
            "gaussian_sets": {"shared": {"means": torch.randn(4, 3)}},
            "decoders": None,
            "color_spaces": {"rgb": "photograph", "thermal": "color"},
            "unscented": False,
            "placement": {},
        },
        "scales": {"thermal": {"kind": "color", "range": (10.0, 30.0), "unit": "celsius"}},
        "training": {"seconds": {"train": 1.5}},
    }


def _archive(path: Path, change: Callable[[dict[str, bytes]], object], **options: Any) -> None:
    """Write a checkpoint, and change the members of its archive, with check sums that are right."""
    save_checkpoint(path, _state())
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    change(members)
    with zipfile.ZipFile(path, "w", **options) as archive:
        for name, content in members.items():
            archive.writestr(name, content)


def test_state_comes_back(tmp_path: Path) -> None:
    """What was saved is what is loaded, tensors and plain values."""
    state = _state()
    save_checkpoint(tmp_path / "ckpts" / "step_000007.pt", state)
    loaded = load_checkpoint(tmp_path / "ckpts" / "step_000007.pt").state()
    means = loaded["model"]["gaussian_sets"]["shared"].pop("means")
    assert torch.equal(means, state["model"]["gaussian_sets"]["shared"].pop("means"))
    for name in ("config", "model", "scales", "step", "sh_degree"):
        assert loaded[name] == state[name]
    assert loaded["training"]["seconds"] == state["training"]["seconds"]
    assert loaded["format"] == FORMAT


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


def test_a_flipped_bit_anywhere_is_named(tmp_path: Path) -> None:
    """Every byte of every tensor and of the pickle has a check sum; torch alone would load most of these."""
    path = tmp_path / "step_000007.pt"
    save_checkpoint(path, _state())
    whole = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        members = [(member.header_offset + 30, member.file_size, member.filename) for member in archive.infolist()]
    for offset, size, name in members:
        start = whole.index(archive_content(path, name), offset) if size else 0
        for place in {start, start + size // 2, start + size - 1} if size else ():
            damaged = bytearray(whole)
            damaged[place] ^= 4
            path.write_bytes(damaged)
            with pytest.raises(UserError, match="damaged or not a thermosplat checkpoint"):
                load_checkpoint(path)
            path.write_bytes(whole)
    load_checkpoint(path)


def archive_content(path: Path, name: str) -> bytes:
    with zipfile.ZipFile(path) as archive:
        return archive.read(name)


class _Runs:
    """What runs a command when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        import os

        return os.system, ("touch pwned",)


def test_a_malicious_pickle_is_refused_in_plain_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing of it runs, and nobody is advised to switch torch's protection off."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "step_000007.pt"
    for protocol in (2, 4):
        torch.save({"format": FORMAT, "model": _Runs()}, path, pickle_protocol=protocol)
        with pytest.raises(UserError, match="which no checkpoint holds") as caught:
            load_checkpoint(path)
        assert "weights_only" not in caught.value.message + caught.value.hint
    path.write_bytes(pickle.dumps({"format": FORMAT}))
    with pytest.raises(UserError, match="damaged or not a thermosplat checkpoint"):
        load_checkpoint(path)
    assert not (tmp_path / "pwned").exists()


def test_a_file_that_unpacks_to_more_than_its_size_is_refused(tmp_path: Path) -> None:
    """A compressed archive may claim any size; torch never writes one."""
    path = tmp_path / "step_000007.pt"
    _archive(path, lambda members: members.update({"zeros": bytes(10**6)}), compression=zipfile.ZIP_DEFLATED)
    assert path.stat().st_size < 10**5
    with pytest.raises(UserError, match="a part of it is compressed"):
        load_checkpoint(path)


@pytest.mark.parametrize(
    "tensor",
    [
        torch.zeros(1).expand(10**12),
        torch.zeros(4).to_sparse(),
        torch.zeros(2, dtype=torch.complex64),
        torch.empty(10**12, device="meta"),
    ],
    ids=["expanded", "sparse", "complex", "meta"],
)
def test_tensors_that_claim_more_than_is_stored_are_refused(tmp_path: Path, tensor: torch.Tensor) -> None:
    """No memory is taken for what a file says of its tensors, and no kernel sees a kind that it does not know."""
    state = _state()
    state["model"]["gaussian_sets"]["shared"]["means"] = tensor
    torch.save({"format": FORMAT, **state}, tmp_path / "x.pt")
    with pytest.raises(UserError, match="damaged or not a thermosplat checkpoint"):
        load_checkpoint(tmp_path / "x.pt")


def test_a_file_of_another_step_is_refused(tmp_path: Path) -> None:
    """A run would go on from a step that it has not reached; the message says how the file should be called."""
    save_checkpoint(tmp_path / "step_000060.pt", _state())
    with pytest.raises(UserError, match="holds step 7, not the step of its name") as caught:
        load_checkpoint(tmp_path / "step_000060.pt")
    assert caught.value.hint.endswith("step_000007.pt")
    (tmp_path / "step_000060.pt").rename(tmp_path / "best.pt")
    assert load_checkpoint(tmp_path / "best.pt").step == 7


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"state_dict": {}}, "no format number"),
        ({"format": FORMAT + 1}, f"reads format {FORMAT}"),
        ({"format": FORMAT, "step": 3}, "config is missing"),
        ({"format": FORMAT, **_state(), "model": {"x": 1}}, r"model\.gaussian_sets is missing"),
        ({"format": FORMAT, **_state(), "config": None}, "config must be a dictionary, found None"),
        ({"format": 1, **_state()}, f"has checkpoint format 1; this version of thermosplat reads format {FORMAT}"),
        ({"format": FORMAT, **_state(), "config": {"brightness": 1}}, "unknown key.*Another version of thermosplat"),
    ],
)
def test_foreign_content_is_explained(tmp_path: Path, content: dict[str, Any], message: str) -> None:
    """A torch file that is no checkpoint of this version says why."""
    torch.save(content, tmp_path / "x.pt")
    with pytest.raises(UserError, match=message):
        load_checkpoint(tmp_path / "x.pt")


@pytest.mark.parametrize(
    ("lens", "stated", "expected"), [("direct", None, True), ("undistort", None, False), ("undistort", True, True)]
)
def test_how_pinholes_see_the_scene(tmp_path: Path, lens: str, stated: bool | None, expected: bool) -> None:
    """A checkpoint that does not say so is of a scene that was trained through lenses if its configuration is."""
    state = _state()
    state["config"]["lens"] = lens
    state["model"].pop("unscented")
    if stated is not None:
        state["model"]["unscented"] = stated
    save_checkpoint(tmp_path / "step_000007.pt", state)
    assert load_checkpoint(tmp_path / "step_000007.pt").model.unscented is expected
    state["model"]["unscented"] = 3
    save_checkpoint(tmp_path / "damaged.pt", state)
    with pytest.raises(UserError, match=r"its model.unscented must be a boolean, found 3"):
        load_checkpoint(tmp_path / "damaged.pt")
