"""One rank of a training is killed (SIGKILL) at any moment: all end, nothing hangs, and what was saved is whole.

    THERMOSPLAT_KILLS=20 pytest -s -m slow tests/faults/test_rank_kills.py --timeout 0 -o faulthandler_timeout=0

Moments are drawn by what the training has said, so that each phase gets its share: meeting, first steps, steps with
checkpoints and evaluations, the end. Five kills go through the phases of one run, which is resumed after each.
"""

import os
import random
import signal
import subprocess
import threading
import time
from contextlib import suppress
from pathlib import Path

import pytest

from thermosplat.runs.checkpoint_file import load_checkpoint
from thermosplat.runs.run_directory import RunDirectory
from training_processes import training_process

KILLS = int(os.environ.get("THERMOSPLAT_KILLS", "5"))
RANKS = 2
LONGEST = 60.0
"""Until all have ended [s]; those that had not met yet are ended by their parent."""
PHASES = ("", "The Gaussians are divided", "step 4/", "held-out views", "step 15/")
"""What the output has said when a rank is killed, some time later."""
WORDS = (
    "--device cpu --data-factor 8 --max-steps 32 --save-steps 6 12 20 --eval-steps 10 --log-every 1 --no-tensorboard "
    "--densification.start-step 2 --densification.every 4"
)

pytestmark = pytest.mark.slow


def _children(parent: int) -> list[int]:
    try:
        text = Path(f"/proc/{parent}/task/{parent}/children").read_text()
    except OSError:
        return []
    return [int(child) for child in text.split()]


def _killed(process: "subprocess.Popen[str]", phase: str, chance: random.Random) -> list[int]:
    """Kill a rank some time after the output has said something; the ranks there were."""
    ranks: list[int] = []
    while len(ranks) < RANKS and process.poll() is None:
        ranks = _children(process.pid)
        time.sleep(0.02)
    assert process.stdout is not None
    if phase:
        next((line for line in process.stdout if phase in line), "")
    time.sleep(chance.uniform(0.0, 0.3 if phase else 4.0))
    victim = chance.choice(ranks)
    with suppress(ProcessLookupError):  # it was quicker
        os.kill(victim, signal.SIGKILL)
    return ranks


def test_ranks_end_together_whenever_one_is_killed(tmp_path: Path) -> None:
    """With one message; and one process goes on from what they saved, to the end."""
    chance = random.Random(0)
    for number in range(KILLS):
        phase, folder = PHASES[number % len(PHASES)], tmp_path / f"run{number // len(PHASES)}"
        known = folder.is_dir() and RunDirectory(folder).holds_a_run() and RunDirectory(folder).latest_checkpoint()
        new = ["sample", *WORDS.split(), "--result-dir", str(folder), "--overwrite"]
        process = training_process(*(["--resume", str(folder)] if known else new), "--devices", str(RANKS))
        ranks = _killed(process, phase, chance)
        killed_at = time.monotonic()
        ended = threading.Timer(2 * LONGEST, process.kill)  # a failure, rather than a test that hangs
        ended.start()
        text = process.stdout.read() if process.stdout is not None else ""
        code = process.wait()
        ended.cancel()
        seconds = time.monotonic() - killed_at
        assert seconds < LONGEST, f"kill {number} in {phase!r} took {seconds:.0f} s:\n{text}"
        assert code in (0, 2), text  # 0: it was quicker
        assert text.count("─ Error ─") == (1 if code else 0), text
        assert "Traceback" not in text
        assert not [rank for rank in ranks if Path(f"/proc/{rank}").exists()], phase
        print(f"kill {number} after {phase!r}: code {code} in {seconds:.1f} s", flush=True)
        for path in RunDirectory(folder).checkpoints() if folder.is_dir() else ():
            assert load_checkpoint(path).step > 0
    for folder in tmp_path.iterdir():
        known = folder.is_dir() and RunDirectory(folder).latest_checkpoint()
        if known:
            last = training_process("--resume", str(folder))
            output, _ = last.communicate(timeout=600)
            assert last.returncode == 0, output
            newest = RunDirectory(folder).latest_checkpoint()
            assert newest is not None
            assert load_checkpoint(newest).step == 16
