"""What captured steps forget when all images get another size; nothing here needs a GPU."""

from typing import Any

import pytest
import torch

from thermosplat.datasets.frame_tensors import FrameTensors
from thermosplat.training import captured_steps
from thermosplat.training.captured_steps import CapturedSteps, Work
from thermosplat.training.frames.shrunk_frames import ShrunkFrames
from thermosplat.training.frames.train_frames import TrainFrames
from thermosplat.training.training_step import StepKind
from toy_run import enlarged, many_frames
from toy_scene import toy_capture


class Recorded:
    """In place of a training step, and of the graphs: how each step was done."""

    def __init__(self) -> None:
        self.done: list[str] = []
        self.state = self
        self.step = 0

    def gradients(self, frame: FrameTensors, kind: StepKind, *, fixed_capacity: bool) -> Any:
        self.done.append("line by line")

    def update(self, kind: StepKind, differentiated: Any) -> None:
        self.step += 1

    def replay(self) -> None:
        self.done.append("replayed")


@pytest.fixture
def recorded(monkeypatch: pytest.MonkeyPatch) -> Recorded:
    """What was done; captures are noted instead of made."""
    recorded = Recorded()

    def capture(steps: CapturedSteps, frames: tuple[FrameTensors, ...], work: Work) -> Any:
        recorded.done.append("captured")
        static = steps._frames.setdefault(work.shapes, tuple(map(captured_steps.packed_elsewhere, frames)))
        return captured_steps.Captured(recorded, static, None)  # type: ignore[arg-type]

    monkeypatch.setattr(torch.cuda, "MemPool", lambda: recorded)
    recorded.id = 0  # type: ignore[attr-defined]
    monkeypatch.setattr(CapturedSteps, "_capture", capture)
    return recorded


def kind_at(factor: float) -> StepKind:
    return StepKind(0, densifying=False, image_factor=factor)


def test_each_size_is_seen_line_by_line_and_then_captured(recorded: Recorded) -> None:
    """After a change, as many steps as at first run line by line, which count the pairs; one graph per size is kept."""
    frames = TrainFrames(enlarged(many_frames(toy_capture()), 3), ("rgb", "thermal"), torch.device("cpu"))
    sized, steps = ShrunkFrames(frames), CapturedSteps(recorded, num_frames=4)  # type: ignore[arg-type]
    kept = []
    for place in range(21):
        factor = (1.5, 1.2, 1.0)[place // 7]
        frame = sized.at(place, lambda later: later % 4, 21, factor)
        with steps.run(frame, kind_at(factor)):
            pass
        kept.append((len(steps._graphs), len(steps._frames)))
        if recorded.done[-1] == "replayed":
            ((static,),) = steps._frames.values()
            assert static.views["rgb"].width == frame.views["rgb"].width
            assert torch.equal(static.views["rgb"].image, frame.views["rgb"].image)
    size = ["line by line"] * 4 + ["captured", "replayed", "replayed", "replayed"]
    assert recorded.done == size * 3
    assert kept == ([(0, 0)] * 4 + [(1, 1)] * 3) * 3


def test_one_size_is_measured_once(recorded: Recorded) -> None:
    """Without smaller images nothing is forgotten."""
    frames = TrainFrames(many_frames(toy_capture()), ("rgb", "thermal"), torch.device("cpu"))
    steps = CapturedSteps(recorded, num_frames=4)  # type: ignore[arg-type]
    for place in range(12):
        with steps.run(frames.at(place, lambda later: later % 4, 12), kind_at(1.0)):
            pass
    assert recorded.done.count("line by line") == 4
    assert recorded.done.count("captured") == 1
