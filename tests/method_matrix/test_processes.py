"""Jobs run one at a time on each device, and none outlives its parent."""

import os
import signal
import sys
import threading
import time
from pathlib import Path

import pytest
import torch

from thermosplat.errors import UserError
from thermosplat.method_matrix.processes import Job, choose_devices, device_environment, python_command, run_jobs

pytestmark = pytest.mark.usefixtures("stoppable")

SAYS_DEVICE = "import os, sys; print('device', os.environ['CUDA_VISIBLE_DEVICES']); sys.exit({code})"
SLEEPS = """
import signal, sys, time

def stop(number, frame):
    print('saved')
    sys.exit(143)

signal.signal(signal.SIGTERM, stop)
signal.signal(signal.SIGINT, signal.SIG_IGN)  # as a shell sets it in the background
print('sleeping', flush=True)
time.sleep(60)
"""


def job(tmp_path: Path, name: str, code: str) -> Job:
    return Job(name, [sys.executable, "-c", code], tmp_path / f"{name}.log")


def test_jobs_are_dealt_to_the_devices(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every job runs once, sees its own device alone, and its output and exit code arrive."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "6,7")
    jobs = [job(tmp_path, f"job{index}", SAYS_DEVICE.format(code=index % 2)) for index in range(4)]
    begun, ended = [], {}
    run_jobs(
        jobs,
        ["cuda:0", "cuda:1"],
        started=lambda job, device: begun.append((job.title, device)),
        done=lambda job, device, code: ended.update({job.title: (device, code)}),
    )
    assert [title for title, _ in begun] == ["job0", "job1", "job2", "job3"]
    assert {device for _, device in begun} == {"cuda:0", "cuda:1"}
    assert {title: code for title, (_, code) in ended.items()} == {"job0": 0, "job1": 1, "job2": 0, "job3": 1}
    for title, (device, _) in ended.items():
        expected = {"cuda:0": "6", "cuda:1": "7"}[device]
        assert (tmp_path / f"{title}.log").read_text() == f"device {expected}\n"


def test_python_files_of_the_current_folder_are_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file called as a module of Python lies in a folder of strangers: a job that imports the module has the real
    one."""
    (tmp_path / "colorsys.py").write_text("print('planted')")
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "imports_it.py").write_text("import colorsys; print(colorsys.rgb_to_hsv(0, 0, 0))")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "site"))
    planted = Job("planted", python_command("imports_it"), tmp_path / "planted.log")
    run_jobs([planted], ["cpu"], started=lambda *_: None, done=lambda *_: None)
    assert planted.log.read_text() == "(0.0, 0.0, 0)\n"


def test_nothing_starts_after_the_time_limit(tmp_path: Path) -> None:
    """What runs then runs to its end; what has not begun is returned."""
    jobs = [job(tmp_path, name, "import time; time.sleep(1); print('whole')") for name in ("first", "second", "third")]
    ended = []
    left = run_jobs(
        jobs,
        ["cpu", "cuda:0"],
        started=lambda *_: None,
        done=lambda job, device, code: ended.append((job.title, code)),
        time_limit=0.5,
    )
    assert left == jobs[2:]
    assert sorted(ended) == [("first", 0), ("second", 0)]
    assert [job.log.read_text() for job in jobs[:2]] == ["whole\n", "whole\n"]
    assert not jobs[2].log.exists()
    assert run_jobs(jobs, ["cpu"], started=lambda *_: None, done=lambda *_: None, time_limit=0.0) == jobs


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_interrupt_reaches_the_jobs_and_waits_for_them(tmp_path: Path, number: signal.Signals) -> None:
    """Ctrl-C, SIGTERM and SIGHUP let every process save before this one ends; nothing new is started."""
    jobs = [job(tmp_path, "first", SLEEPS), job(tmp_path, "second", SLEEPS)]

    def interrupt_when_both_sleep() -> None:
        while not all(j.log.is_file() and "sleeping" in j.log.read_text() for j in jobs):
            time.sleep(0.05)
        os.kill(os.getpid(), number)

    watcher = threading.Thread(target=interrupt_when_both_sleep, daemon=True)
    watcher.start()
    with pytest.raises(KeyboardInterrupt):
        run_jobs(jobs, ["cpu", "cuda:0"], started=lambda *_: None, done=lambda *_: None)
    watcher.join()
    assert all("saved" in job.log.read_text() for job in jobs)


def test_reason_of_a_failure(tmp_path: Path) -> None:
    """The last line that a process wrote, or the signal that ended it; also where it wrote nothing at all."""
    failing = job(tmp_path, "failing", "")
    assert failing.reason(2) == "it wrote nothing"
    failing.log.write_text("step 3\nError: No capture here. Give another.\n\n")
    assert failing.reason(2) == "No capture here. Give another."
    failing.log.write_text("Traceback (most recent call last):\n  File x\nValueError: broken\n")
    assert failing.reason(1) == "ValueError: broken"
    assert failing.reason(-signal.SIGKILL) == "ended by SIGKILL"


def test_environment_of_a_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """A GPU's index counts among the visible ones; on the CPU none is visible."""
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    assert device_environment("cuda:3")["CUDA_VISIBLE_DEVICES"] == "3"
    assert device_environment("cpu")["CUDA_VISIBLE_DEVICES"] == ""


def test_processes_share_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each process of several has its part of them, or what the user says."""
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    assert "OMP_NUM_THREADS" not in device_environment("cuda:0")
    assert device_environment("cuda:0", sharing=4)["OMP_NUM_THREADS"] == "16"
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    assert device_environment("cuda:0", sharing=4)["OMP_NUM_THREADS"] == "3"


def test_devices_of_a_command_line() -> None:
    """The CPU by name; twice the same, or one that is not there, is a user's error."""
    assert choose_devices(["cpu"]) == ["cpu"]
    assert choose_devices([])
    with pytest.raises(UserError, match="twice"):
        choose_devices(["cpu", "cpu"])
    with pytest.raises(UserError, match="cuda:99"):
        choose_devices(["cuda:99"])


def test_a_number_of_gpus(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first ones; more than there are, or names beside it, is a user's error."""
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 4)
    assert choose_devices([], gpus=2) == ["cuda:0", "cuda:1"]
    assert choose_devices([]) == [f"cuda:{index}" for index in range(4)]
    with pytest.raises(UserError, match="--gpus 5, but this process sees 4"):
        choose_devices([], gpus=5)
    with pytest.raises(UserError, match="--devices names them"):
        choose_devices(["cpu"], gpus=1)
