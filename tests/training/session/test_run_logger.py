"""What a run says: plain lines, the live line, metrics.jsonl and TensorBoard."""

import errno
import io
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch
from rich.console import Console

from thermosplat.runs.run_directory import RunDirectory
from thermosplat.training.session import run_logger
from thermosplat.training.session.run_logger import RunLogger, StepRecord


def _logger(path: Path, *, terminal: bool = False, **changes: Any) -> tuple[RunLogger, io.StringIO]:
    output = io.StringIO()
    console = Console(file=output, force_terminal=terminal, width=200, highlight=False)
    settings = {"max_steps": 20, "log_every": 5, "device": torch.device("cpu"), "tensorboard": False, **changes}
    return RunLogger(RunDirectory(path), console=console, **settings), output


def _record(step: int, **losses: float) -> StepRecord:
    return StepRecord(
        step=step,
        losses={name: torch.tensor(value) for name, value in (losses or {"rgb": 0.5}).items()},
        squared_errors={"rgb": torch.tensor(0.01)},
        num_gaussians=1234,
        sh_degree=1,
        train_seconds=step * 0.5,
    )


def _entries(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]


def test_plain_lines_every_interval(tmp_path: Path) -> None:
    """Without a terminal there is one unbroken line every log_every steps, and one for the last step."""
    logger, output = _logger(tmp_path, max_steps=12)
    logger.start(0)
    for step in range(1, 13):
        logger.step(_record(step))
    lines = output.getvalue().splitlines()
    assert [line.split()[1] for line in lines] == ["5/12", "10/12", "12/12"]
    assert "2.0 it/s  ETA 0:01" in lines[1]
    assert "rgb 20.00 dB" in lines[1]
    assert "1,234 Gaussians" in lines[1]
    assert "loss 0.5000 rgb 0.5000" in lines[1]


@pytest.mark.parametrize("ending", ["close", "evaluation"])
def test_lines_of_a_gpu_are_late_but_not_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: str) -> None:
    """A line is that of its step although others were done meanwhile; the end and an evaluation do not wait for it."""
    monkeypatch.setattr(run_logger, "memory_bytes", lambda device: 0)
    logger, output = _logger(tmp_path, device=torch.device("cuda"))
    logger.start(0)
    for step in range(1, 9):
        logger.step(_record(step, rgb=0.1 * step))
    assert output.getvalue() == ""
    logger.step(_record(9))
    assert _entries(tmp_path)[0] == {**_entries(tmp_path)[0], "step": 5, "rgb": pytest.approx(0.3)}
    assert output.getvalue().split()[1] == "5/20"
    logger.step(_record(10, rgb=0.7))
    logger.step(_record(11, rgb=9.0))
    if ending == "close":
        logger.close()
    else:
        logger.evaluation(11, {"spectra": []})
    second = _entries(tmp_path)[1]
    assert second["step"] == 10
    assert second["rgb"] == pytest.approx((0.6 + 0.7 + 0.8 + 0.5 + 0.7) / 5)


def test_narrow_log_file_keeps_one_line_a_record(tmp_path: Path) -> None:
    """Lines for a file are not broken at its assumed width."""
    logger, output = _logger(tmp_path)
    logger.console.width = 20
    logger.start(0)
    for step in range(1, 6):
        logger.step(_record(step))
    assert len(output.getvalue().splitlines()) == 1


def test_values_are_means_over_the_interval(tmp_path: Path) -> None:
    """Losses in metrics.jsonl are means since the last line, their sum is the loss; terms may come and go."""
    logger, _ = _logger(tmp_path)
    logger.start(0)
    for step in range(1, 11):
        losses = {"rgb": 0.1 * step} if step % 2 else {"rgb": 0.1 * step, "thermal": 1.0}
        logger.step(_record(step, **losses))
    first, second = _entries(tmp_path)
    assert first["step"] == 5
    assert first["rgb"] == pytest.approx(0.3)
    assert second["rgb"] == pytest.approx(0.8)
    assert second["thermal"] == pytest.approx(1.0)
    assert second["loss"] == pytest.approx(1.8)
    assert second["psnr_rgb"] == pytest.approx(20.0)
    assert second["num_gaussians"] == 1234
    assert second["memory_bytes"] > 2**20


def test_values_are_read_once_an_interval(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a GPU the device is waited for only where a line is due, live line or not."""
    logger, _ = _logger(tmp_path, terminal=True)
    logger.device = torch.device("cuda")
    monkeypatch.setattr(run_logger, "memory_bytes", lambda device: 2**30)
    monkeypatch.setattr(run_logger, "REFRESH_SECONDS", 0.0)
    reads, genuine = [], torch.Tensor.tolist
    monkeypatch.setattr(torch.Tensor, "tolist", lambda tensor: reads.append(1) or genuine(tensor))
    logger.start(0)
    for step in range(1, 11):
        logger.step(_record(step))
    logger.close()
    assert len(reads) == 2


def test_live_line_on_a_terminal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a terminal the line is rewritten in place between the intervals, and taken down at the end."""
    monkeypatch.setattr(run_logger, "REFRESH_SECONDS", 0.0)
    logger, output = _logger(tmp_path, terminal=True)
    logger.start(0)
    for step in range(1, 4):
        logger.step(_record(step))
    logger.close()
    text = output.getvalue()
    assert "step 3/20" in text
    assert "\x1b[?25h" in text  # the cursor is back
    assert not (tmp_path / "metrics.jsonl").exists()  # no interval is over


def test_evaluation_is_said_and_kept(tmp_path: Path) -> None:
    """Held-out numbers are printed, go to metrics.jsonl, and stand in the lines that follow; null stays null."""
    logger, output = _logger(tmp_path)
    logger.start(0)
    metrics = {
        "rgb": {"psnr": 23.456, "ssim": 0.81, "lpips": None},
        "thermal": {"psnr": 25.0, "ssim": 0.9, "lpips": 0.2, "mae_celsius": 0.31, "bias_celsius": -0.2},
        "nir": {"psnr": 31.0, "ssim": 0.95, "lpips": None, "mae_reflectance": 0.00854, "miou": 0.5},
        "spectra": ["rgb", "thermal", "nir"],
        "num_gaussians": 7,
    }
    logger.evaluation(4, metrics)
    logger.step(_record(5))
    printed = output.getvalue()
    assert (
        "rgb PSNR 23.46 dB SSIM 0.810; thermal PSNR 25.00 dB SSIM 0.900 LPIPS 0.200 MAE 0.31 °C bias -0.20 °C; nir"
        in " ".join(printed.split())
    )
    assert "nir PSNR 31.00 dB SSIM 0.950 MAE 0.0085 reflectance miou 0.50" in " ".join(printed.split())
    assert "(held-out 23.46)" in printed
    assert _entries(tmp_path)[0] == {"step": 4, "evaluation": metrics}


def test_evaluation_without_a_spectrum(tmp_path: Path) -> None:
    """A run on RGB alone, or a capture with nothing held out, has nothing to say about the rest."""
    logger, output = _logger(tmp_path)
    logger.start(0)
    rgb, both = {"psnr": None, "ssim": 0.8, "lpips": None}, ["rgb", "thermal"]
    logger.evaluation(4, {"rgb": rgb, "thermal": None, "spectra": both, "num_gaussians": 7})
    logger.evaluation(5, {"rgb": None, "thermal": None, "spectra": both, "num_gaussians": 7})
    logger.evaluation(6, {"rgb": rgb, "spectra": ["rgb"], "num_gaussians": 7})
    assert output.getvalue().splitlines() == [
        "step 4: held-out views: rgb SSIM 0.800",
        "step 5: held-out views: none",
        "step 6: held-out views: rgb SSIM 0.800",
    ]


def test_resumed_run_drops_later_lines(tmp_path: Path) -> None:
    """Lines from after the checkpoint, and one that a crash cut off, are gone; earlier ones stay."""
    (tmp_path / "metrics.jsonl").write_text('{"step": 5}\n{"step": 10}\n{"step": 15}\n{"step": 2')
    logger, _ = _logger(tmp_path)
    logger.start(10)
    logger.step(_record(15))
    assert [entry["step"] for entry in _entries(tmp_path)] == [5, 10, 15]


def test_a_run_that_starts_again_has_the_new_lines_alone(tmp_path: Path) -> None:
    """Values from before do not go into the first mean after; on a GPU, the line that waits is said."""
    logger, output = _logger(tmp_path, device=torch.device("cuda"))
    logger.start(0)
    for step in range(1, 8):
        logger.step(_record(step, rgb=1.0))
    logger.start_again()
    for step in range(1, 6):
        logger.step(_record(step, rgb=3.0))
    logger.close()
    assert [(entry["step"], entry["rgb"]) for entry in _entries(tmp_path)] == [(5, 3.0)]
    assert [line.split()[1] for line in output.getvalue().splitlines()] == ["5/20", "5/20"]


def test_infinite_psnr_is_null_in_json(tmp_path: Path) -> None:
    """A perfect image has no finite PSNR; JSON gets null, and who looks at the line reads it."""
    logger, output = _logger(tmp_path)
    logger.start(0)
    logger.step(StepRecord(5, {"rgb": torch.tensor(0.0)}, {"rgb": torch.tensor(0.0)}, 1, 0, 1.0))
    assert _entries(tmp_path)[0]["psnr_rgb"] is None
    assert "rgb inf dB" in output.getvalue()


@pytest.mark.parametrize(("long", "said"), [(60.0, False), (0.01, True)])
def test_compiling_is_said_when_it_takes_long(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, long: float, said: bool
) -> None:
    """The first step announces compilation only if it takes a while."""
    monkeypatch.setattr(run_logger, "COMPILING_AFTER_SECONDS", long)
    logger, output = _logger(tmp_path)
    with logger.compiling():
        while said and not output.getvalue():
            time.sleep(0.01)
    assert ("compiling kernels (first run only" in output.getvalue()) == said


def test_tensorboard_events(tmp_path: Path) -> None:
    """Losses and held-out numbers are in the event files."""
    pytest.importorskip("tensorboard", reason="tensorboard is not installed")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    logger, _ = _logger(tmp_path, tensorboard=True)
    logger.start(0)
    for step in range(1, 6):
        logger.step(_record(step))
    rgb = {"psnr": 23.0, "ssim": 0.8, "lpips": None}
    nir = {"psnr": 30.0, "mae_reflectance": 0.05}
    logger.evaluation(5, {"rgb": rgb, "thermal": None, "nir": nir, "spectra": ["rgb", "thermal", "nir"]})
    logger.close()
    events = EventAccumulator(str(tmp_path / "tb"))
    events.Reload()
    assert events.Scalars("train/loss")[0].value == pytest.approx(0.5)
    assert events.Scalars("held_out/rgb_psnr")[0].step == 5
    assert events.Scalars("held_out/nir_mae_reflectance")[0].value == pytest.approx(0.05)


def test_missing_tensorboard_is_a_hint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the package training goes on, and one line says what to install."""
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    logger, output = _logger(tmp_path, tensorboard=True)
    logger.start(0)
    logger.step(_record(5))
    assert 'pip install ".[tensorboard]"' in output.getvalue()
    assert _entries(tmp_path)[0]["step"] == 5


def test_an_evaluation_that_is_made_again_is_told_once(tmp_path: Path) -> None:
    """A run that was killed behind its last evaluation writes the line anew; that of a step in the middle stays."""
    lines = [{"step": 4, "loss": 1.0}, {"step": 4, "evaluation": {}}, {"step": 5, "loss": 1.0}]
    for evaluates, kept in ((False, lines[:2]), (True, lines[:1])):
        (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines) + '{"step": 4')
        _logger(tmp_path)[0].start(4, evaluates=evaluates)
        assert _entries(tmp_path) == kept


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_full_disk_costs_lines_not_the_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lines that cannot be written are told once, those of TensorBoard too, and every step goes on being said."""

    class FullWriter:
        def __init__(self, *_: object, **__: object) -> None: ...

        def add_scalar(self, *_: object) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(run_logger, "open_to_append", lambda path: open("/dev/full", "wb"))  # noqa: SIM115
    monkeypatch.setattr("torch.utils.tensorboard.SummaryWriter", FullWriter)
    logger, output = _logger(tmp_path, tensorboard=True)
    logger.start(0)
    for step in range(1, 16):
        logger.step(_record(step))
    logger.close()
    said = output.getvalue()
    assert said.count("metrics.jsonl: No space left on device. Training goes on") == 1
    assert said.count("TensorBoard files are written no further: No space left on device.") == 1
    assert said.count("Gaussians") == 3


@pytest.mark.parametrize("number", [errno.EPIPE, errno.ENOSPC, errno.EIO])
def test_an_output_that_cannot_be_written_is_told_once(
    number: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nobody reads it, the disk is full, or the terminal is gone: rich would end the process."""

    class Gone(io.StringIO):
        def flush(self) -> None:
            raise OSError(number, os.strerror(number))

    logger = RunLogger(RunDirectory(tmp_path), max_steps=5, log_every=1, device=torch.device("cpu"), tensorboard=False)
    logger.console.file = Gone()
    logger.say("a line")
    logger.say("another")
    logger.close()
    assert capsys.readouterr().err == f"The output cannot be written ({os.strerror(number)}). The command goes on.\n"


@pytest.mark.parametrize(("seconds", "text"), [(0.4, "0:00"), (59.6, "1:00"), (754, "12:34"), (4354, "1:12:34")])
def test_durations_read_as_on_a_clock(seconds: float, text: str) -> None:
    """Durations read as on a clock, with hours where there are some."""
    assert run_logger.duration(seconds) == text
