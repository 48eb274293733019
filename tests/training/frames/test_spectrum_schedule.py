"""Which spectra a step trains, on which frames, and how far a set of Gaussians is in its own schedule."""

import dataclasses

import pytest
import torch

from thermosplat.config import TrainConfig
from thermosplat.datasets.capture import Capture
from thermosplat.errors import UserError
from thermosplat.training.frames.spectrum_schedule import FrameOrder, Span, SpectrumSchedule, set_span, spectrum_spans
from thermosplat.training.frames.train_frames import TrainFrames
from toy_run import many_frames, toy_run_config, without
from toy_scene import toy_capture

CPU = torch.device("cpu")
IN_TURN = {"rgb": {"train_until": 0.5}, "thermal": {"train_from": 0.5}}


def schedule_of(capture: Capture, config: TrainConfig) -> SpectrumSchedule:
    return SpectrumSchedule(config, TrainFrames(capture, config.modelled, CPU))


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
        assert list(tensors.views) == ["rgb", "thermal"]
        assert tensors.shared_cameras == (("rgb", "thermal"),)
        assert schedule.frame(done).name == tensors.name == capture.train[order[done]].name


def test_fine_tuning_schedule() -> None:
    """RGB alone for the first half, thermal alone for the second; sets count from where their training starts."""
    config = toy_run_config(8, spectra=IN_TURN)
    schedule = schedule_of(many_frames(toy_capture()), config)
    shown = [list(frame.views) for frame in map(schedule.tensors, range(8))]
    assert shown == [["rgb"]] * 4 + [["thermal"]] * 4
    assert spectrum_spans(config) == {"rgb": Span(0, 4), "thermal": Span(4, 8)}
    assert (set_span("thermal", config), set_span("shared", config)) == (Span(4, 8), Span(0, 8))


def test_frames_without_the_trained_view_are_passed_over() -> None:
    """Where only thermal is trained, only frames with a thermal image come."""
    capture = many_frames(toy_capture())
    frames = tuple(without(frame, "thermal") if index else frame for index, frame in enumerate(capture.train))
    config = toy_run_config(8, spectra=IN_TURN)
    schedule = schedule_of(dataclasses.replace(capture, train=frames), config)
    assert {schedule.frame(done).name for done in range(4)} == {frame.name for frame in frames}
    assert {schedule.frame(done).name for done in range(4, 8)} == {frames[0].name}


def test_a_phase_without_frames_is_a_users_error() -> None:
    """RGB first on a capture without RGB images cannot work."""
    config = toy_run_config(8, spectra={"thermal": {"train_from": 0.5}})
    with pytest.raises(UserError, match="step 1 is to learn from") as caught:
        schedule_of(many_frames(toy_capture(rgb=False)), config)
    assert "train_from and train_until" in caught.value.hint


def test_three_spans_overlap_as_they_like() -> None:
    """Every step shows the spectra whose span holds it, in groups of one camera; sets have the span of theirs."""
    spans = {"rgb": {"train_until": 0.5}, "thermal": {"train_from": 0.25}, "nir": {"train_from": 0.5}}
    config = toy_run_config(8, spectra=spans)
    capture = many_frames(toy_capture(others=("nir",)))
    schedule = schedule_of(capture, config)
    tensors = [schedule.tensors(done) for done in range(8)]
    assert [list(frame.views) for frame in tensors] == (
        [["rgb"]] * 2 + [["rgb", "thermal"]] * 2 + [["thermal", "nir"]] * 4
    )
    assert all(frame.shared_cameras == (tuple(frame.views),) for frame in tensors)
    assert spectrum_spans(config) == {"rgb": Span(0, 4), "thermal": Span(2, 8), "nir": Span(4, 8)}
    assert [set_span(name, config) for name in ("nir", "shared", "decoders")] == [Span(4, 8), Span(0, 8), Span(0, 8)]
    apart = schedule_of(many_frames(toy_capture(others=("nir",), aligned=False)), config)
    assert apart.tensors(3).shared_cameras == (("rgb",), ("thermal",))
    assert apart.tensors(4).shared_cameras == (("nir",), ("thermal",))


def test_frames_of_three_spectra_take_turns() -> None:
    """Cameras that take turns: a phase goes through all frames that show something it trains on, each once an epoch."""
    capture = many_frames(toy_capture(others=("nir",)), 7)
    shown = ("rgb", "thermal", "nir")
    frames = tuple(
        without(frame, *(name for name in shown if name != shown[index % 3]))
        for index, frame in enumerate(capture.train)
    )
    config = toy_run_config(12, spectra={"rgb": {"train_until": 2 / 3}, "nir": {"train_from": 2 / 3}})
    schedule = schedule_of(dataclasses.replace(capture, train=frames), config)
    of_first = {frame.name for frame in frames if "nir" not in frame.views}
    of_second = {frame.name for frame in frames if "rgb" not in frame.views}
    assert {schedule.frame(done).name for done in range(4)} == of_first
    assert {schedule.frame(done).name for done in range(8, 12)} == of_second
    for done in range(12):
        tensors = schedule.tensors(done)
        assert len(tensors.views) == 1
        assert tensors.name == schedule.frame(done).name


def test_a_spectrum_that_is_left_out_has_no_span() -> None:
    """``--without`` leaves neither its span nor its views."""
    config = toy_run_config(8, spectra={"nir": {}}, without=("thermal",))
    assert spectrum_spans(config) == {"rgb": Span(0, 8), "nir": Span(0, 8)}
    schedule = schedule_of(many_frames(toy_capture(others=("nir",))), config)
    assert {tuple(schedule.tensors(done).views) for done in range(8)} == {("rgb", "nir")}


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
