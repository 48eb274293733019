"""A training in a process of its own, stopped from outside: nothing is lost, and it says how to go on."""

import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from training_processes import environment

pytestmark = pytest.mark.usefixtures("stoppable")


def _terminate(process: "subprocess.Popen[str]") -> None:
    process.send_signal(signal.SIGTERM)


_TRAIN = """
import signal, sys
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # under nohup it would be ignored, as it should be there
from thermosplat.cli.train import main
sys.exit(main())
"""


def _hang_up(process: "subprocess.Popen[str]") -> None:
    process.send_signal(signal.SIGHUP)


def _stop_reading(process: "subprocess.Popen[str]") -> None:
    assert process.stdout is not None
    process.stdout.close()
    checkpoint = Path(process.args[-1]) / "ckpts" / "step_000030.pt"  # type: ignore[index, arg-type]
    while process.poll() is None and not checkpoint.exists():  # it trains on
        time.sleep(0.1)
    process.send_signal(signal.SIGTERM)


@pytest.mark.rotating("commands in processes")
@pytest.mark.parametrize(
    ("stop", "code"), [(_terminate, 143), (_hang_up, 129), (_stop_reading, 143)], ids=["SIGTERM", "SIGHUP", "head"]
)
def test_stopped_training_is_saved(tmp_path: Path, stop: Callable[["subprocess.Popen[str]"], None], code: int) -> None:
    """A checkpoint, a sentence with the command that goes on, the shell's code; no stack of pycolmap's."""
    run = tmp_path / "run"
    words = "sample --data-factor 4 --device cpu --no-tensorboard --log-every 1 --max-steps 10000 --save-steps 30"
    with subprocess.Popen(
        [
            sys.executable,
            "-c",
            _TRAIN,
            *words.split(),
            "--result-dir",
            run,
        ],
        stdout=subprocess.PIPE,
        stderr=(tmp_path / "stderr").open("w"),
        text=True,
        env=environment(),
    ) as process:
        assert process.stdout is not None
        next(line for line in process.stdout if line.startswith("step 3"))
        stop(process)
        said = "" if process.stdout.closed else process.stdout.read()
    said += (tmp_path / "stderr").read_text()
    assert process.returncode == code, said[-2000:]
    checkpoint = max((run / "ckpts").iterdir())
    assert f"saved {checkpoint}" in said
    assert f"thermosplat-train --resume {run}" in said
    assert "Traceback" not in said
    assert "***" not in said  # as glog begins its stacks
    assert ("The output cannot be written (Broken pipe). The command goes on." in said) == (stop is _stop_reading)
