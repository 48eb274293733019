"""What captured steps forget when all images get another size; nothing here needs a GPU."""

from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from thermosplat.distributed.team import Team
from thermosplat.training import recorded_steps
from thermosplat.training.frames.shrunk_frames import ShrunkFrames
from thermosplat.training.frames.train_frames import TrainFrames
from thermosplat.training.recorded_steps import RecordedSteps
from thermosplat.training.step_kind import Plan, StepKind
from toy_run import enlarged, many_frames
from toy_scene import toy_capture

PLAN = Plan(("shared",), (((("rgb", "thermal"),),),))


class Recorded:
    """In place of a training step, and of the graphs: how each step was done."""

    def __init__(self) -> None:
        self.done: list[str] = []
        self.state = self
        self.team = Team.of_one(torch.device("cpu"))
        self.capacity = SimpleNamespace(measure=lambda: None)
        self.noise = torch.Generator()
        self.step = 0

    def gradients(self, frames: Any, kind: StepKind, plan: Plan, *, fixed_capacity: bool) -> Any:
        self.done.append("captured" if fixed_capacity else "line by line")

    def update(self, kind: StepKind, differentiated: Any) -> None:
        self.step += 1

    def replay(self) -> None:
        self.done.append("replayed")


@pytest.fixture
def recorded(monkeypatch: pytest.MonkeyPatch) -> Recorded:
    """What was done; captures are noted instead of made."""
    recorded = Recorded()
    monkeypatch.setattr(torch.cuda, "MemPool", lambda: SimpleNamespace(id=0))
    monkeypatch.setattr(torch.cuda, "CUDAGraph", lambda: recorded)
    monkeypatch.setattr(recorded_steps, "captured_in", lambda graph, pool: nullcontext())
    return recorded


def kind_at(factor: float) -> StepKind:
    return StepKind(0, densifying=False, image_factor=factor)


def test_each_size_is_seen_line_by_line_and_then_captured(recorded: Recorded) -> None:
    """After a change, as many steps as at first run line by line, which count the pairs; one graph per size is kept."""
    frames = TrainFrames(enlarged(many_frames(toy_capture()), 3), ("rgb", "thermal"), torch.device("cpu"))
    sized, steps = ShrunkFrames(frames), RecordedSteps(recorded, num_frames=4)  # type: ignore[arg-type]
    kept = []
    for place in range(21):
        factor = (1.5, 1.2, 1.0)[place // 7]
        frame = sized.at(place, lambda later: later % 4, 21, factor)
        steps.run((frame,), PLAN, kind_at(factor))
        kept.append((len(steps.graphs), len(steps.frames)))
        if recorded.done[-1] == "replayed":
            ((static,),) = steps.frames.values()
            assert static.views["rgb"].width == frame.views["rgb"].width
            assert torch.equal(static.views["rgb"].image, frame.views["rgb"].image)
    size = ["line by line"] * 4 + ["captured", "replayed", "replayed", "replayed"]
    assert recorded.done == size * 3
    assert recorded.step == 21
    assert kept == ([(0, 0)] * 4 + [(1, 1)] * 3) * 3


def test_one_size_is_measured_once(recorded: Recorded) -> None:
    """Without smaller images nothing is forgotten."""
    frames = TrainFrames(many_frames(toy_capture()), ("rgb", "thermal"), torch.device("cpu"))
    steps = RecordedSteps(recorded, num_frames=4)  # type: ignore[arg-type]
    for place in range(12):
        steps.run((frames.at(place, lambda later: later % 4, 12),), PLAN, kind_at(1.0))
    assert recorded.done.count("line by line") == 4
    assert recorded.done.count("captured") == 1
