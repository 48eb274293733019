"""Which spectra a step trains, on which frames, and how far a set of Gaussians is in its own schedule."""

import dataclasses

import pytest
import torch
from toy_run import many_frames, toy_run_config

from thermosplat.config import ScheduleConfig, TrainConfig
from thermosplat.datasets.capture import Capture
from thermosplat.errors import UserError
from thermosplat.training.modality_schedule import ModalitySchedule, Span, modality_spans, set_span
from thermosplat.training.random_streams import FrameOrder
from thermosplat.training.train_frames import TrainFrames
from toy_scene import toy_capture

CPU = torch.device("cpu")


def schedule_of(capture: Capture, config: TrainConfig) -> ModalitySchedule:
    return ModalitySchedule(config, TrainFrames(capture, config.model, CPU))


def test_span_holds_the_steps_after_its_start() -> None:
    """A span from 3 to 6 holds steps 4, 5 and 6, and is a third done before step 5."""
    span = Span(3, 6)
    assert [step for step in range(10) if step in span] == [4, 5, 6]
    assert [span.progress(done) for done in (0, 3, 4, 6, 9)] == pytest.approx([0, 0, 1 / 3, 1, 1])


def test_without_a_schedule_every_step_trains_both() -> None:
    """The default: all steps, both views, every frame once an epoch in the seed's order."""
    config, capture = toy_run_config(8), many_frames(toy_capture())
    schedule, order = schedule_of(capture, config), FrameOrder(4, config.seed)
    for done in range(8):
        tensors = schedule.tensors(done)
        assert tensors.rgb is not None
        assert tensors.thermal is not None
        assert tensors.aligned
        assert schedule.frame(done).name == tensors.name == capture.train[order[done]].name


def test_fine_tuning_schedule() -> None:
    """RGB alone for the first half, thermal alone for the second; sets count from where their training starts."""
    config = toy_run_config(8, schedule=ScheduleConfig(thermal_from=0.5, rgb_until=0.5))
    schedule = schedule_of(many_frames(toy_capture()), config)
    shown = [(frame.rgb is not None, frame.thermal is not None) for frame in map(schedule.tensors, range(8))]
    assert shown == [(True, False)] * 4 + [(False, True)] * 4
    assert modality_spans(config) == {"rgb": Span(0, 4), "thermal": Span(4, 8)}
    assert (set_span("thermal", config), set_span("shared", config)) == (Span(4, 8), Span(0, 8))


def test_frames_without_the_trained_view_are_passed_over() -> None:
    """Where only thermal is trained, only frames with a thermal image come."""
    capture = many_frames(toy_capture())
    frames = tuple(
        dataclasses.replace(frame, thermal=None) if index else frame for index, frame in enumerate(capture.train)
    )
    config = toy_run_config(8, schedule=ScheduleConfig(thermal_from=0.5, rgb_until=0.5))
    schedule = schedule_of(dataclasses.replace(capture, train=frames), config)
    assert {schedule.frame(done).name for done in range(4)} == {frame.name for frame in frames}
    assert {schedule.frame(done).name for done in range(4, 8)} == {frames[0].name}


def test_a_phase_without_frames_is_a_users_error() -> None:
    """RGB first on a capture without RGB images cannot work."""
    config = toy_run_config(8, schedule=ScheduleConfig(thermal_from=0.5))
    with pytest.raises(UserError, match="step 1 is to learn from"):
        schedule_of(many_frames(toy_capture(rgb=False)), config)


def test_withheld_frames_are_not_trained_on() -> None:
    """While frames are withheld the others take all steps; afterwards all do."""
    capture = many_frames(toy_capture())
    schedule = schedule_of(capture, toy_run_config(8))
    schedule.withhold((1, 3))
    assert {schedule.frame(done).name for done in range(8)} == {capture.train[0].name, capture.train[2].name}
    schedule.withhold(())
    assert len({schedule.frame(done).name for done in range(8)}) == 4
    with pytest.raises(UserError, match="No training frame"):
        schedule.withhold(range(4))
