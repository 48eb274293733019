"""A training on several ranks that is watched: rank 0 shows it, and tells the others what to do together.

Rank 0 renders a whole copy of the scene. After each step all ranks hear whether rank 0 calls them together, with the
number that says whether one of them is to stop. Ranks that are called do what rank 0 says, until it lets them go on. A
pause is one long such meeting: rank 0 speaks all the time, so that a signal to any rank ends the pause.
"""

import time
from enum import Enum, auto
from pathlib import Path

from thermosplat.scene.model import SceneModel
from thermosplat.stop_signals import Stopped, signal_of
from thermosplat.training.session.safekeeping import given
from thermosplat.training.trainer import Trainer
from thermosplat.viewer.training_watch import TrainingWatch
from thermosplat.viewer.turns import TRAINING_SHARE

COPY_SECONDS = 2.0
"""From one copy of the scene to the next one at least [s], while training goes on."""


class Word(Enum):
    """What rank 0 tells ranks that it has called."""

    GO_ON = auto()
    WAIT = auto()
    COPY = auto()
    SAVE = auto()


class Follower:
    """A rank that is not the first: it does what rank 0 says."""

    def __init__(self, trainer: Trainer) -> None:
        self._trainer = trainer
        trainer.between_steps = lambda _: self.between_steps()

    def between_steps(self) -> None:
        """Called after each step."""
        trainer = self._trainer
        if not trainer.meetings.called:
            return
        while (word := _heard(trainer)) is not Word.GO_ON:
            if word is Word.COPY:
                trainer.keeping.gathered(training=False)
            elif word is Word.SAVE:
                trainer.save()


class Leader:
    """Rank 0, which has the viewers. What they see and ask goes through it (``training_watch.Watched``).

    Args:
        watch: What viewers ask; its scene gets the copies.
    """

    def __init__(self, trainer: Trainer, watch: TrainingWatch) -> None:
        self._trainer, self._watch = trainer, watch
        self._has_copy = False
        self._next_copy = 0.0
        watch.on_wait = self._wait
        trainer.meetings.calls = self.calls
        trainer.between_steps = lambda _: self.between_steps()

    @property
    def step(self) -> int:
        """Steps done."""
        return self._trainer.step

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics in use."""
        return self._trainer.sh_degree

    def save(self) -> Path:
        """Write a checkpoint of the steps done, by all ranks."""
        self._say(Word.SAVE)
        return self._trainer.save()

    def calls(self) -> bool:
        """Whether all ranks are to come together: a viewer asks for something, or its copy is old."""
        watch = self._watch
        if watch.asked:
            return True
        return watch.has_viewers() and (watch.paused or time.perf_counter() >= self._next_copy)

    def between_steps(self) -> None:
        """Called after each step."""
        trainer, watch = self._trainer, self._watch
        if not trainer.meetings.called:
            self._go_on_alone()
            return
        try:
            self._copy()
            watch.between_steps(self)
        except KeyboardInterrupt as stop:  # a viewer's, or a signal to any rank; all stop after this meeting
            trainer.meetings.note(signal_of(stop))
        self._say(Word.GO_ON)

    def _go_on_alone(self) -> None:
        """Between two meetings: show the copy that there is, or let it go."""
        watch = self._watch
        if not self._has_copy:
            return
        if watch.has_viewers():
            watch.between_copies(self)
        else:
            self._has_copy, self._next_copy = False, 0.0
            watch.scene.model = self._trainer.model

    def _copy(self) -> None:
        """Show the scene of now. What the copy costs is paid for by a pause after it."""
        trainer, scene, started = self._trainer, self._watch.scene, time.perf_counter()
        self._say(Word.COPY)
        whole = given(trainer.keeping.gathered(training=False))
        scene.model = SceneModel.from_checkpoint(whole, "cpu")  # the last copy leaves the device before
        scene.model.to(trainer.device)
        self._has_copy, now = True, time.perf_counter()
        self._next_copy = now + max(COPY_SECONDS, (now - started) * (1 / TRAINING_SHARE - 1))

    def _wait(self) -> None:
        """Let the others wait on."""
        numbers = [number for number in self._say(Word.WAIT) if number]
        if numbers:
            raise Stopped(numbers[0])

    def _say(self, word: Word) -> list[int]:
        """Tell the others; the signals that the ranks have had, by rank, 0 for none."""
        trainer = self._trainer
        return [number for _, number in trainer.team.objects((word, trainer.meetings.signal))]


def _heard(trainer: Trainer) -> Word:
    """What rank 0 says."""
    word: Word = trainer.team.objects((None, trainer.meetings.signal))[0][0]
    return word
