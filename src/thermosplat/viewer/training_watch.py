"""Training that is watched: renders between its steps, and what viewers ask of it: pause, step, save, stop."""

import json
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from thermosplat.viewer.turns import BetweenSteps
from thermosplat.viewer.viewed_scene import ViewedScene

CHANGE_SECONDS = 1.0
"""How often viewers are told that the model has changed."""


class Watched(Protocol):
    """What a training shows and lets be done; ``training.trainer.Trainer`` is one."""

    @property
    def step(self) -> int:
        """Steps done."""

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics in use."""

    def save(self) -> Path:
        """Write a checkpoint of the steps done."""


class TrainingWatch:
    """Between the thread that trains and the viewers.

    Args:
        max_steps: Steps of the whole training.
        metrics: The run's metrics.jsonl, which is read for the plots.
    """

    def __init__(self, scene: ViewedScene, max_steps: int, metrics: Path) -> None:
        self.scene = scene
        self.max_steps = max_steps
        self.turns = BetweenSteps()
        self.curves = Curves(metrics)
        self.step = 0
        """Steps done."""
        self.message = ""
        """What became of the last wish."""
        self.on_change: Callable[[], None] = lambda: None
        """Called now and then when the model has changed."""
        self.on_progress: Callable[[], None] = lambda: None
        """Called now and then when the training has gone on, and the model that is shown is the same."""
        self.has_viewers: Callable[[], bool] = lambda: False
        """Whether anybody watches."""
        self.on_wait: Callable[[], None] = lambda: None
        """Called ten times a second while training waits; may raise KeyboardInterrupt."""
        self._paused = threading.Event()
        self._single_steps = 0
        self._save = self._stop = False
        self._told = self._told_progress = 0.0

    @property
    def paused(self) -> bool:
        """Whether training waits."""
        return self._paused.is_set()

    @property
    def asked(self) -> bool:
        """Whether a viewer has asked for something that is not done yet: a step, to save, to stop."""
        return self._save or self._stop or self._single_steps > 0

    # ---- what viewers ask --------------------------------------------------------------------------------------------

    def pause(self, paused: bool) -> None:
        """Let training wait after its present step, or go on; single steps that were asked for before are forgotten."""
        self._single_steps = 0
        (self._paused.set if paused else self._paused.clear)()
        self.turns.wake()

    def do_step(self) -> None:
        """One step while training waits."""
        self._single_steps += 1
        self.turns.wake()

    def save(self) -> None:
        """Save a checkpoint after the present step."""
        self._save = True
        self.turns.wake()

    def stop(self) -> None:
        """End training after the present step, as Ctrl-C does."""
        self._stop = True
        self.turns.wake()

    # ---- the thread that trains --------------------------------------------------------------------------------------

    def between_steps(self, trainer: Watched) -> None:
        """Called after each step, when the model is whole.

        Raises:
            KeyboardInterrupt: A viewer has stopped it.
        """
        self.step, self.scene.sh_degree = trainer.step, trainer.sh_degree
        if not self.has_viewers() and not self.asked:
            return
        now = time.perf_counter()
        if now - self._told >= CHANGE_SECONDS:
            self._told = now
            self.on_change()
        self._obey(trainer)
        if not self.paused:
            self.turns.take()
            return
        self.on_change()
        while self.paused and not self._single_steps and not self._stop:
            if not self.has_viewers():  # who closed the last tab left nobody to go on
                self.pause(False)
            self.turns.take_until(self._waits_no_more)
            self._obey(trainer)
        self._single_steps = max(0, self._single_steps - 1)

    def between_copies(self, trainer: Watched) -> None:
        """Called after a step that the scene, a copy of the model, does not know of yet; nothing is obeyed."""
        self.step = trainer.step
        now = time.perf_counter()
        if now - self._told_progress >= CHANGE_SECONDS:
            self._told_progress = now
            self.on_progress()
        self.turns.take()

    def _waits_no_more(self) -> bool:
        self.on_wait()
        return not self.paused or self.asked or not self.has_viewers()

    def _obey(self, trainer: Watched) -> None:
        if self._stop:
            raise KeyboardInterrupt
        if self._save:
            self._save = False
            self.message = f"Saved {trainer.save()}"
            self.on_change()


class Curves:
    """The lines of metrics.jsonl, read as it grows."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._read = 0
        self._rest = b""
        self._lock = threading.Lock()
        self.lines: list[dict[str, Any]] = []
        """Lines of training steps, in their order."""

    def read(self) -> list[dict[str, Any]]:
        """Take in what was written since the last time; all lines."""
        with self._lock:
            try:
                size = self._path.stat().st_size
                if size < self._read:  # begun anew
                    self._read, self._rest, self.lines = 0, b"", []
                with self._path.open("rb") as file:
                    file.seek(self._read)
                    content = file.read(size - self._read)
            except OSError:
                return self.lines
            self._read += len(content)
            *whole, self._rest = (self._rest + content).split(b"\n")
            for line in whole:
                try:
                    entry = json.loads(line)
                except ValueError:
                    continue
                if isinstance(entry, dict) and "loss" in entry and isinstance(entry.get("step"), int):
                    self.lines.append(entry)
            return self.lines

    def series(self, wanted: Callable[[str], bool]) -> tuple[list[int], dict[str, list[float]]]:
        """Steps, and the values of some columns at them; NaN where a line lacks one.

        Args:
            wanted: Of a column's name, whether it is.
        """
        lines = list(self.lines)
        names = list(dict.fromkeys(name for line in lines for name in line if wanted(name)))
        values = {name: [_number(line.get(name)) for line in lines] for name in names}
        return [line["step"] for line in lines], values


def is_loss(name: str) -> bool:
    """Whether a column of metrics.jsonl is a loss or a term of it."""
    others = ("step", "num_gaussians", "sh_degree", "train_seconds", "memory_bytes")
    return name not in others and not is_psnr(name)


def is_psnr(name: str) -> bool:
    """Whether a column of metrics.jsonl is a spectrum's PSNR."""
    return name.startswith("psnr_")


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else float("nan")
