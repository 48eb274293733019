"""When a spectrum whose images are noisy is fitted well enough: ``--budget auto``.

Each training view has a floor in each spectrum: the squared error below which it is not fitted (noise_floor.py). At
first that is the variance of the images' noise. But a model has an error of its own, so it learns noise long before it
comes so near. Withheld training views show when: from then on they get worse. So the floors of a spectrum rise to the
errors that its views had when the withheld ones were best, while others go on. At the same error more and more of what
is learnt is noise, though, so that withheld views may go on to fall, more slowly. If they are still below their best
when the watch ends, the spectrum goes back to it: the scene as it was then teaches what is left to train (teacher.py).
That is decided at the end, since two views may be wrong about the first fall.

Only spectra are held whose error is to a good part noise: in images without noise, what withheld views lose by a view
more or less is not noise that was learnt. But where views are few, a spectrum whose withheld views have lost much by
the end of the watch goes back whatever its noise: a scene may fit few views ever better and be ever worse. It may also
be worse for a while only, so that the watch lasts longer where they have lost much.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from thermosplat.runs.checkpoint import Checkpoint
from thermosplat.training.budget.teacher import Teacher

NOISY = 0.4
"""Share of noise in the squared error of the training views from which on a spectrum may be held. In desk's photographs
with the noise of 140 electrons at white it is over a half when withheld views begin to get worse."""
SOON_NOISY = 0.2
"""Share from which on a spectrum is watched: as its error falls, noise becomes a larger part of it. Open choice."""


class NoiseWatch:
    """How far the views are fitted, and how far they may be, of the spectra whose images have noise.

    Args:
        noise: By spectrum, the squared error below which no view is fitted, more than 0.
        num_frames: Training frames.

    Attributes:
        floors: By spectrum, the squared errors below which the frames are not fitted, [num_frames] float32.
        errors: By spectrum, the squared errors that the frames had when they were last trained on, [num_frames]
            float32; 0 where that was never.
        best: By spectrum that was watched, the best PSNR of the withheld views [dB] and its step.
        lately: Likewise steps and PSNR of the last looks.
        held: The spectra whose floors have risen.
        teachers: By spectrum, what those that went back to where they were best are trained on.
        over: Whether none is watched any more, and no view withheld for it.
    """

    def __init__(self, noise: Mapping[str, float], num_frames: int, device: torch.device) -> None:
        self.noise = dict(noise)
        self.floors = {name: torch.full((num_frames,), value, device=device) for name, value in noise.items()}
        self.errors = {name: torch.zeros(num_frames, device=device) for name in noise}
        self.best: dict[str, tuple[float, int]] = {}
        self.lately: dict[str, list[tuple[int, float]]] = {}
        self._errors_at_best: dict[str, Tensor] = {}
        self._best_teachers: dict[str, Teacher] = {}
        self.held: tuple[str, ...] = ()
        self.teachers: dict[str, Teacher] = {}
        self.over = False

    @classmethod
    def of_checkpoint(cls, checkpoint: Checkpoint, num_frames: int, device: torch.device) -> "NoiseWatch":
        """The watch of a checkpoint that has one; arguments as of the class.

        Raises:
            KeyError, ValueError, UserError: As of ``load_state_dict`` and ``load_teachers``.
        """
        saved = checkpoint.training.noise_watch or {}
        watch = cls(saved["noise"], num_frames, device)
        watch.load_state_dict(saved)
        watch.load_teachers(saved, checkpoint)
        return watch

    def measured_anew(self, noise: Mapping[str, float]) -> None:
        """Let floors follow the noise of the images as they are now: a resumed run may have them smaller.

        Args:
            noise: As that of the class.
        """
        for name in self.noise.keys() & noise.keys():
            if noise[name] != self.noise[name]:
                self.floors[name] *= noise[name] / self.noise[name]
                self.noise[name] = noise[name]

    def forget(self) -> None:
        """Begin again with a new scene."""
        for name, floors in self.floors.items():
            floors.fill_(self.noise[name])
            self.errors[name].zero_()
        self.best, self.lately, self._errors_at_best, self.held, self.over = {}, {}, {}, (), False
        self.forget_teachers()

    def forget_teachers(self) -> None:
        """Hold spectra by floors alone."""
        self._best_teachers, self.teachers = {}, {}

    def end(self, loss: float = math.inf, fall: float = math.inf) -> list[str]:
        """Watch no further spectrum.

        Args:
            loss: What withheld views must have lost [dB] for a held spectrum to go back to where it was best.
            fall: What they must have lost in all of the last looks for any spectrum to go back.

        Returns:
            The spectra that go back: they have teachers from now on.
        """
        fallen = self.fallen(fall)
        found = [
            name
            for name in self._best_teachers
            if name in fallen or (name in self.held and self.best[name][0] - self._looks(name)[-1] >= loss)
        ]
        self.teachers |= {name: self._best_teachers[name] for name in found}
        self.over, self._best_teachers = True, {}
        return found

    def fallen(self, fall: float) -> list[str]:
        """The spectra that could go back and whose withheld views have lost as much in all of the last looks.

        Args:
            fall: The loss [dB].
        """
        return [name for name in self._best_teachers if self.best[name][0] - max(self._looks(name)) >= fall]

    def _looks(self, name: str) -> list[float]:
        """PSNR of the withheld views in the last looks; infinite where there were none."""
        return [psnr for _, psnr in self.lately.get(name, ())] or [math.inf]

    @torch.no_grad()
    def note(self, index: Tensor, squared_errors: Mapping[str, Tensor]) -> None:
        """Note the errors of a frame; nothing here waits for the device.

        Args:
            index: The frame's, an int64 scalar on the device.
            squared_errors: By spectrum, scalars.
        """
        for name, errors in self.errors.items():
            if name in squared_errors:
                errors.index_copy_(0, index.view(1), squared_errors[name].detach().view(1))

    def floors_of(self, index: Tensor, taught: float) -> dict[str, Tensor]:
        """By spectrum, the squared error below which a frame is not fitted, scalars; nothing here waits for the device.

        Args:
            index: The frame's, an int64 scalar on the device.
            taught: Of what a teacher shows, the floor as a share of what it would be of the frame's own image.
        """
        return {
            name: floors.index_select(0, index.view(1)).view(()) * (taught if name in self.teachers else 1.0)
            for name, floors in self.floors.items()
        }

    def noise_share(self, name: str) -> float:
        """What part of the squared error of a spectrum's training views is noise; 0 before they were trained on.

        Args:
            name: One of ``noise``.
        """
        error = _mean_of_seen(self.errors[name])
        return self.noise[name] / error if error > 0 else 0.0

    def watches(self) -> bool:
        """Whether there is a spectrum whose best withheld views may be yet to come, or be lost again."""
        return any(self.noise_share(name) >= SOON_NOISY for name in self.noise)

    def judge(
        self,
        step: int,
        psnrs: Mapping[str, float],
        loss: float,
        patience: float,
        teacher: Callable[[], Teacher | None] = lambda: None,
        *,
        noisy_only: bool = True,
    ) -> list[str]:
        """Raise the floors of spectra that withheld views say are fitted too closely; note who is better than ever.

        Args:
            step: The step done.
            psnrs: PSNR of the withheld views [dB], the mean of each spectrum.
            loss: What it must have lost [dB].
            patience: Steps since it was best, and those whose looks are remembered.
            teacher: The scene as it is now; None where there is no room for it.
            noisy_only: Watch no spectrum whose error has little noise.

        Returns:
            The spectra that are held from now on.
        """
        shares = {name: self.noise_share(name) for name in self.noise if name in psnrs}
        watched = [name for name, share in shares.items() if share >= SOON_NOISY or not noisy_only]
        better = [name for name in watched if psnrs[name] > self.best.get(name, (-math.inf, 0))[0]]
        now = teacher() if better else None
        for name in better:
            self.best[name] = psnrs[name], step
            self._errors_at_best[name] = self.errors[name].clone()
            self._best_teachers.pop(name, None)
            if now is not None:
                self._best_teachers[name] = now
        found = []
        for name in watched:
            best, best_step = self.best[name]
            before = [look for look in self.lately.get(name, ()) if step - look[0] < patience]
            self.lately[name] = [*before, (step, psnrs[name])]
            fallen = best - psnrs[name] >= loss and step - best_step >= patience
            if fallen and shares[name] >= NOISY and name not in self.held:
                self._hold(name)
                found.append(name)
        return found

    def _hold(self, name: str) -> None:
        errors = self._errors_at_best[name]
        mean = _mean_of_seen(errors)
        risen = torch.where(errors > 0, errors, mean)  # withheld views were never trained on
        torch.maximum(self.floors[name], risen, out=self.floors[name])
        self.held = (*self.held, name)

    def state_dict(self, *, teachers: bool = True) -> dict[str, Any]:
        """Tensors and built-in types.

        Args:
            teachers: With them, each as large as the model.
        """
        own, of_best = (self.teachers, self._best_teachers) if teachers else ({}, {})
        return {
            "noise": self.noise,
            "floors": self.floors,
            "errors": self.errors,
            "best": self.best,
            "lately": self.lately,
            "errors_at_best": self._errors_at_best,
            "held": self.held,
            "over": self.over,
            "teachers": {name: teacher.state_dict() for name, teacher in own.items()},
            "best_teachers": {name: teacher.state_dict() for name, teacher in of_best.items()},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """The inverse of ``state_dict`` but for teachers, for the same spectra and frames.

        Args:
            state: Of another watch.

        Raises:
            KeyError: An entry is missing.
            ValueError: An entry does not fit the frames.
        """
        best = {name: (float(psnr), int(step)) for name, (psnr, step) in state["best"].items() if name in self.noise}
        at_best = {name: self._of_frames(state["errors_at_best"][name]) for name in best}
        for own, saved in ((self.floors, state["floors"]), (self.errors, state["errors"])):
            for name, tensor in own.items():
                tensor.copy_(self._of_frames(saved[name]))
        self.best, self._errors_at_best = best, at_best
        lately = state.get("lately", {})
        self.lately = {n: [(int(step), float(psnr)) for step, psnr in lately[n]] for n in self.noise if n in lately}
        self.held = tuple(name for name in self.noise if name in state["held"])
        self.over = bool(state["over"])

    def load_teachers(self, state: Mapping[str, Any], checkpoint: Checkpoint) -> None:
        """The teachers of ``state_dict``.

        Args:
            state: Of another watch. Those of older versions have no teachers.
            checkpoint: What it lay in.

        Raises:
            KeyError: An entry is missing.
            UserError: A teacher does not fit the model.
        """
        device = next(iter(self.floors.values())).device
        for own, key in ((self.teachers, "teachers"), (self._best_teachers, "best_teachers")):
            own.clear()
            for name, saved in state.get(key, {}).items():
                if name in self.noise:
                    own[name] = Teacher.from_state(saved, checkpoint, device)

    def _of_frames(self, tensor: Any) -> Tensor:
        own = next(iter(self.floors.values()))
        if not isinstance(tensor, Tensor) or tensor.shape != own.shape:
            raise ValueError(f"There must be one number for each of {len(own)} frames.")
        return tensor.to(own)


def _mean_of_seen(errors: Tensor) -> float:
    """The mean error of the frames that were trained on; 0 where none was. Waits for the device."""
    seen = errors > 0
    return float(errors.sum() / seen.sum().clamp(min=1))
