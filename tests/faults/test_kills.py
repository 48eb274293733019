"""Trainings that are killed (SIGKILL) at any moment and resumed: nothing is lost but what no checkpoint has yet.

    THERMOSPLAT_KILLS=100 pytest -s -m slow tests/faults/test_kills.py --timeout 0 -o faulthandler_timeout=0

Moments are drawn by time, which finds the steps, and by the files that are touched, which finds checkpoints,
evaluations and the last export, before a file is opened or renamed and some milliseconds later.
"""

import os
import random
import signal
import time
from pathlib import Path

import pytest

from killed_training import STEPS, begin, contents
from thermosplat.runs.atomic_writes import is_temporary
from thermosplat.runs.checkpoint_file import load_checkpoint
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.runs.run_lock import LOCK_FILE

KILLS = int(os.environ.get("THERMOSPLAT_KILLS", "4"))
MOST_IN_A_CHAIN = 6
FILES_TOUCHED = 116
"""By a run that nobody stops."""


pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, float]:
    """A run that nobody stopped, and how long it took [s]."""
    folder = tmp_path_factory.mktemp("kills") / "whole"
    begin(folder.with_name("warm"), None).join()  # kernels are compiled, and the server of processes is there
    started = time.monotonic()
    process = begin(folder, None)
    process.join()
    assert process.exitcode == 0
    return folder, time.monotonic() - started


def newest(run: RunDirectory) -> int:
    """The step of the newest checkpoint, which is whole; 0 where there is none."""
    path = run.latest_checkpoint()
    return 0 if path is None else load_checkpoint(path).step


def killed(folder: Path, chance: random.Random, seconds: float) -> bool:
    """Train until a random moment; whether that came before the end."""
    by_time = chance.random() < 0.4
    delay = chance.choice([0.0, chance.uniform(0.0, 0.01)])
    process = begin(folder, None if by_time else (chance.randint(1, FILES_TOUCHED), delay))
    if by_time:
        process.join(chance.uniform(0.0, seconds))
        process.kill()
    process.join()
    assert process.exitcode in (0, -signal.SIGKILL)
    return process.exitcode != 0


def test_killed_runs_end_as_one_that_nobody_stopped(whole: tuple[Path, float], tmp_path: Path) -> None:
    """No checkpoint is ever lost or half written, all files are equal to the last bit, and nothing is left lying."""
    expected, seconds = contents(whole[0]), whole[1]
    chance, kills, chains = random.Random(7), 0, 0
    while kills < KILLS:
        folder, saved, of_chain = tmp_path / f"chain{chains}", 0, 0
        chains += 1
        while of_chain < MOST_IN_A_CHAIN and kills < KILLS and killed(folder, chance, seconds):
            of_chain, kills = of_chain + 1, kills + 1
            now = newest(RunDirectory(folder))
            assert now >= saved, f"chain {chains}: a checkpoint of step {saved} is gone"
            saved = now
        last = begin(folder, None)
        last.join()
        assert last.exitcode == 0
        found = contents(folder)
        assert found.keys() == expected.keys(), f"chain {chains}"
        assert [name for name in expected if found[name] != expected[name]] == [], f"chain {chains}"
        assert not any(is_temporary(path.name) or path.name == LOCK_FILE for path in folder.rglob("*"))
        assert newest(RunDirectory(folder)) == STEPS
        print(f"{kills} kills in {chains} chains: all as they should be", flush=True)
