"""One process per device: how they are asked for, and how they end."""

import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from thermosplat.cli.training import devices
from thermosplat.cli.training.devices import check_devices, devices_asked
from thermosplat.errors import UserError
from training_processes import training_process


def test_a_number_of_devices_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """As the next word or after "="; a process that is a rank already starts no others."""
    monkeypatch.delenv("RANK", raising=False)
    assert devices_asked(["data/shed", "--max-steps", "7"]) is None
    assert devices_asked(["data/shed", "--devices", "4"]) == 4
    assert devices_asked(["--devices=2", "data/shed"]) == 2
    for wrong in ("0", "-1", "two", ""):
        with pytest.raises(UserError, match="--devices must be"):
            devices_asked(["--devices", wrong])
    monkeypatch.setenv("RANK", "0")
    assert devices_asked(["data/shed", "--devices", "4"]) is None


def test_devices_that_are_not_there_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """The CPU takes any number; GPUs are counted before a process is started for each."""
    import torch

    check_devices(7, "cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    check_devices(2, "auto")
    with pytest.raises(UserError, match="more GPUs than the 2"):
        check_devices(3, "auto")
    with pytest.raises(UserError, match="names one device"):
        check_devices(2, "cuda:1")


@pytest.mark.parametrize(
    ("end", "said"), [("exit 3", "Rank 1 of 2 ended with code 3"), ("kill -9 $$", "Rank 1 of 2 was killed by SIGKILL")]
)
def test_a_rank_that_ends_before_it_meets_the_others_ends_them(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    stoppable: None,
    end: str,
    said: str,
) -> None:
    """They wait for it in the C++ of torch, where only a signal's default action ends them."""
    program = tmp_path / "python"
    program.write_text(f"#!/bin/sh\nif [ $RANK = 1 ]; then {end}; fi\nexec sleep 60\n")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    monkeypatch.setattr(devices, "TELLING", 0.1)
    assert devices.train_on_devices(2, ["sample"]) == 2
    assert said in " ".join(capfd.readouterr().err.replace("│", " ").split())


def _ranks(parent: int) -> dict[str, int]:
    """Process by rank."""
    found = {}
    for child in Path(f"/proc/{parent}/task/{parent}/children").read_text().split():
        variables = dict(
            entry.split("=", 1) for entry in Path(f"/proc/{child}/environ").read_text().split("\0") if "=" in entry
        )
        found[variables["RANK"]] = int(child)
    return found


STOPS = [
    (lambda parent: os.kill(_ranks(parent)["0"], signal.SIGKILL), 2, "Rank 0 of 2"),
    (lambda parent: os.kill(_ranks(parent)["1"], signal.SIGTERM), 143, "Stopped at step"),
    (lambda parent: os.kill(parent, signal.SIGINT), 130, "Stopped at step"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("stop", "code", "said"), STOPS, ids=["rank 0 killed", "SIGTERM", "Ctrl-C"])
def test_ranks_end_together(stoppable: None, tmp_path: Path, stop: Callable[[int], None], code: int, said: str) -> None:
    """With one message, the last checkpoint and the command that goes on; no process is left."""
    words = (
        "sample --devices 2 --device cpu --data-factor 8 --max-steps 20000 --save-steps 10 --eval-steps 20000 "
        "--log-every 1 --no-tensorboard --result-dir"
    )
    with training_process(*words.split(), tmp_path / "run") as process:
        assert process.stdout is not None
        next(line for line in process.stdout if line.startswith("step 12"))
        ranks = _ranks(process.pid)
        stop(process.pid)
        text = process.stdout.read()
        assert process.wait(timeout=120) == code
    assert not [rank for rank in ranks.values() if Path(f"/proc/{rank}").exists()]
    words_of_text = " ".join(text.replace("│", " ").split())
    assert words_of_text.count(said) == 1
    assert "--resume" in words_of_text
    assert "run --devices 2" in words_of_text
    assert ".pt" in words_of_text
