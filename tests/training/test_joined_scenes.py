"""Scenes that are trained apart and become one: what the union shows, and the run that makes it."""

import dataclasses
import math
import signal
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.nn.functional import logsigmoid

from thermosplat.config import AutoBudgetConfig, TrainConfig
from thermosplat.config.checks import check_config
from thermosplat.config.files import load_config
from thermosplat.config.run_schedule import in_steps
from thermosplat.datasets.capture import Capture
from thermosplat.datasets.frame_tensors import frame_tensors
from thermosplat.errors import UserError
from thermosplat.runs.checkpoint_file import load_checkpoint, save_checkpoint
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.scene.gaussians import Gaussians
from thermosplat.scene.offloaded import OffloadedParameter
from thermosplat.stop_signals import stopped_by_signals
from thermosplat.torch_bridge.host_rows import on_cpu
from thermosplat.training import sensor_facts
from thermosplat.training.budget import image_change
from thermosplat.training.joined_scenes import joined, seed_of_scene, steps_of_scene, thinned_logits
from thermosplat.training.new_scenes import NewScenes
from thermosplat.training.session.interruption import TrainingInterrupted
from thermosplat.training.stages.scenes import SceneStage
from thermosplat.training.step_kind import StepValues
from thermosplat.training.trainer import Trainer
from toy_run import (
    assert_same_state,
    many_frames,
    state_tensors,
    stopped_and_resumed,
    tolerating,
    toy_run_config,
    toy_trainer,
)
from toy_scene import toy_capture, toy_config, toy_model


def scenes_config(steps: int = 20, scenes: int = 2, **changes: Any) -> TrainConfig:
    """Two scenes of 16 steps, and four steps of both."""
    made = toy_run_config(steps, scenes=scenes, **changes)
    return dataclasses.replace(made, optimizer=dataclasses.replace(made.optimizer, cooldown_from=0.8))


@pytest.fixture
def capture() -> Capture:
    return many_frames(toy_capture())


@pytest.mark.parametrize("number", [2, 3, 7])
def test_so_many_thinned_ones_are_as_opaque_as_one(number: int) -> None:
    """From next to nothing to next to everything; float64, by what they let through."""
    logits = torch.linspace(-60.0, 60.0, 241, dtype=torch.float64)
    thinned = thinned_logits(logits, number)
    torch.testing.assert_close(number * logsigmoid(-thinned), logsigmoid(-logits), rtol=1e-9, atol=0.0)


def test_one_stays_what_it_is() -> None:
    logits = torch.linspace(-30.0, 30.0, 61)
    torch.testing.assert_close(thinned_logits(logits, 1), logits)


def test_a_gaussian_joined_with_itself_shows_the_same() -> None:
    """Exactly at its peak; where it has the share g of that, both are more opaque by h² g (1 - g), h the half of it."""
    capture = toy_capture()
    model = toy_model(toy_config(decoder={"hidden_dim": 8}), capture)
    model.gaussian_sets["shared"] = only = Gaussians(
        {name: value.detach()[:1] for name, value in model.gaussians("shared").named_parameters()}
    )
    frame = frame_tensors(capture.train[0], capture.scales, "cpu")
    with torch.no_grad():
        one = model.render(frame.views, sh_degree=1).alphas
        model.gaussian_sets["shared"] = joined([only, only])
        both = model.render(frame.views, sh_degree=1).alphas
    assert model.num_gaussians == 2
    for name, alpha in one.items():
        opacity = only.opacities_in(name).detach()
        half = 1 - torch.sqrt(1 - opacity)
        expected = alpha + half**2 * (alpha / opacity) * (1 - alpha / opacity)
        drawn = alpha > 0.02  # halves fainter than 1/255 are not drawn
        assert drawn.sum() > 20
        torch.testing.assert_close(both[name][drawn], expected[drawn], rtol=1e-4, atol=1e-5)


def test_every_opacity_is_thinned() -> None:
    """α, a spectrum's by an offset, and a spectrum's own."""
    logits, offsets, own = torch.tensor([-2.0, 3.0]), torch.tensor([1.5, -4.0]), torch.tensor([0.3, 9.0])
    made = Gaussians(
        {
            "means": torch.zeros(2, 3),
            "logit_opacities": logits,
            "thermal_opacity_offsets": offsets,
            "logit_other_opacities": own,
        }
    )
    both = dict(joined([made, made, made]).named_parameters())
    through = torch.sigmoid(torch.stack([-logits, -(logits + offsets), -own]))
    found = torch.stack(
        [
            both["logit_opacities"][:2],
            (both["logit_opacities"] + both["thermal_opacity_offsets"])[:2],
            both["logit_other_opacities"][:2],
        ]
    )
    torch.testing.assert_close(torch.sigmoid(-found) ** 3, through, rtol=1e-5, atol=1e-7)


def test_seeds_of_scenes() -> None:
    """The first scene has the run's; all are seeds, also of the largest one."""
    assert seed_of_scene(42, 0) == 42
    assert len({seed_of_scene(seed, number) for seed in range(100) for number in range(5)}) == 500
    assert all(0 <= seed_of_scene(2**63 - 1, number) < 2**63 for number in range(5))


def test_one_run_trains_all_scenes(tmp_path: Path, capture: Capture) -> None:
    """Each from the same points with other random numbers; the second keeps the decoders of the first."""
    trainer = toy_trainer(tmp_path, scenes_config(), capture)
    start = trainer.model.gaussians("shared").features.detach().clone()
    for _ in range(16):
        trainer.train_step()
    (first,) = trainer.state.preliminaries.kept_scenes
    assert trainer.step == 0  # its steps are those of the result
    assert trainer.state.preliminaries.under_way is False
    again = trainer.model.gaussians("shared")
    assert len(again) == len(capture.points)
    assert not torch.equal(again.features, start)
    decoders = {key: value.clone() for key, value in trainer.model.formations.decoder.state_dict().items()}
    for _ in range(16):
        trainer.train_step()
    assert trainer.step == 16
    assert not trainer.state.preliminaries.kept_scenes
    second = len(trainer.model.gaussians("shared")) - len(first["shared"]["means"])
    assert second > len(capture.points)  # both have grown
    for key, value in trainer.model.formations.decoder.state_dict().items():
        assert torch.equal(value, decoders[key])
    trainer.train_step()
    trained = trainer.model.formations.decoder.state_dict()
    assert any(not torch.equal(value, decoders[key]) for key, value in trained.items())


def test_what_a_user_sees(tmp_path: Path, capture: Capture, capsys: pytest.CaptureFixture[str]) -> None:
    """Which scene is trained, that they become one, and one evaluation at a step that each of them has."""
    metrics = toy_trainer(tmp_path, scenes_config(eval_steps=(10,)), capture).train()
    said = capsys.readouterr().out
    assert "scene 1 of 2: step 10/20" in said
    assert "scene 2 of 2: step 10/20" in said
    assert said.index("Scene 1 of 2 is trained") < said.index("scene 2 of 2") < said.index("All 2 scenes become one of")
    assert "\nstep 20/20" in said
    assert said.count("step 10: held-out views") == 1
    assert metrics["steps"] == 20
    assert [path.name for path in sorted((tmp_path / "ckpts").iterdir())][-1] == "step_000020.pt"


@pytest.mark.rotating("resumed runs")
@pytest.mark.parametrize("passed", [5, 16, 16 + 7, 16 + 16, 16 + 18])
def test_an_interrupted_run_goes_on_exactly(tmp_path: Path, capture: Capture, passed: int) -> None:
    """In the first scene, between the two, in the second, where they become one, and after that."""
    config = scenes_config()
    whole = toy_trainer(tmp_path / "whole", config, capture)
    whole.train()
    first = toy_trainer(tmp_path / "parts", config, capture)
    for _ in range(passed):
        first.train_step()
    first.save()
    second = Trainer.resume(config, capture, first.run)
    assert second.step == first.step
    assert second.state.preliminaries.seed == first.state.preliminaries.seed
    second.train()
    assert_same_state(state_tensors(second), state_tensors(whole))


def stopped(trainer: Trainer) -> Path:
    """The checkpoint that a run leaves which SIGTERM stops."""
    with pytest.raises(TrainingInterrupted) as caught, stopped_by_signals():
        trainer.train()
    return caught.value.checkpoint


@pytest.mark.rotating
@pytest.mark.parametrize("passed", [16, 16 + 16])
def test_a_scene_that_a_signal_ends_is_left_when_the_run_goes_on(
    tmp_path: Path, capture: Capture, monkeypatch: pytest.MonkeyPatch, passed: int
) -> None:
    """Stopped in its last step, when it is not yet kept or joined: with the same numbers as if nothing had stopped."""
    config = scenes_config()
    whole = toy_trainer(tmp_path / "whole", config, capture)
    whole.train()
    first = toy_trainer(tmp_path / "parts", config, capture)
    update, updates = first.device_step.update, []

    def update_and_stop(*arguments: Any) -> StepValues:
        updates.append(update(*arguments))
        if len(updates) == passed:
            signal.raise_signal(signal.SIGTERM)
        return updates[-1]

    monkeypatch.setattr(first.device_step, "update", update_and_stop)
    assert stopped(first).name == "step_000016.pt"
    second = Trainer.resume(config, capture, first.run)
    second.train()
    assert_same_state(state_tensors(second), state_tensors(whole))


def test_a_stop_while_the_next_scene_starts_leaves_that_one(tmp_path: Path, capture: Capture) -> None:
    """An older checkpoint of more steps is gone, so that the run goes on with the next scene."""
    first = stopped_and_resumed(tmp_path, scenes_config(), capture, 10)
    begin = first.beginnings.begin_scene

    def begin_and_stop() -> None:
        begin()
        signal.raise_signal(signal.SIGTERM)

    first.beginnings.begin_scene = begin_and_stop  # type: ignore[method-assign]
    assert stopped(first).name == "step_000000.pt"
    second = Trainer.resume(scenes_config(), capture, first.run)
    assert (second.step, len(second.state.preliminaries.kept_scenes)) == (0, 1)


@pytest.mark.rotating("long trainings")
@tolerating(prune_change=0.002, measured_views=3)
def test_a_budget_looks_once_more_at_what_they_became(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each scene withholds views while it grows, and loses Gaussians; so does the one that all become. (Views that are
    noisy would stay withheld for longer.)"""
    monkeypatch.setattr(sensor_facts, "NOISY_IMAGES", math.inf)
    monkeypatch.setattr(image_change, "LEARNT", -300.0)  # toy images are noise, which no scene learns
    capture = many_frames(toy_capture(), 25)
    budget = AutoBudgetConfig(prune_at=(0.5, 0.9), validate_every=4)
    config = scenes_config(40, budget="auto", auto_budget=budget)
    config = dataclasses.replace(config, densification=dataclasses.replace(config.densification, stop_step=18))
    trainer = toy_trainer(tmp_path, config, capture)
    withheld, numbers = [], []
    for _ in range(32 + 32 + 8):
        trainer.train_step()
        withheld.append(len({trainer.schedule.frame(step).name for step in range(25)}) < len(trainer.frames))
        numbers.append(trainer.model.num_gaussians)
    assert withheld[0]
    assert not withheld[25]
    assert withheld[32]
    assert not withheld[32 + 25]
    assert numbers[20] < numbers[18]
    assert numbers[32 + 20] < numbers[32 + 18]
    assert numbers[64 + 4] < numbers[63]
    trainer.budget.finish(1)


def test_separate_sets_become_one_each(tmp_path: Path, capture: Capture) -> None:
    """A set for every spectrum, without decoders."""
    made = scenes_config(model={"gaussian_sets": "separate", "feature_dim": 0})
    trainer = toy_trainer(tmp_path, made, capture)
    for _ in range(31):
        trainer.train_step()
    second = {name: len(gaussians) for name, gaussians in trainer.state.gaussian_sets.items()}
    first = {name: len(packed["means"]) for name, packed in trainer.state.preliminaries.kept_scenes[0].items()}
    trainer.train_step()
    assert set(second) == {"rgb", "thermal"}
    for name, gaussians in trainer.state.gaussian_sets.items():
        assert len(gaussians) >= first[name] + second[name] > 2 * len(capture.points)


@pytest.mark.rotating
@pytest.mark.parametrize("kind", ["on", "moments"])
def test_offloaded_scenes_become_one(tmp_path: Path, capture: Capture, kind: str) -> None:
    """What lies in the host's memory lies there again, and learns on; where and how opaque all is, is the same."""
    usual = toy_trainer(tmp_path / "usual", scenes_config(), capture)
    offloaded = toy_trainer(tmp_path / "offloaded", scenes_config(offload=kind), capture)
    for trainer in (usual, offloaded):
        for _ in range(16 + 16):
            trainer.train_step()
    found = offloaded.model.gaussians("shared")
    for name in ("means", "log_scales", "logit_opacities", "thermal_opacity_offsets"):
        torch.testing.assert_close(found.get_parameter(name), usual.model.gaussians("shared").get_parameter(name))
    assert isinstance(found.features, OffloadedParameter)
    assert found.features.on_host == (kind == "on")
    before = on_cpu(found.features).clone()
    offloaded.train_step()
    assert not torch.equal(on_cpu(found.features), before)


def test_cameras_are_found_before_the_first_scene(tmp_path: Path) -> None:
    """And not again: later scenes begin with them."""
    capture = many_frames(toy_capture(aligned=False))
    passes: dict[str, Any] = {"refine": ("rig",), "refine_from": 0, "refine_every": 1, "refine_first": 2}
    trainer = toy_trainer(tmp_path, scenes_config(**passes), capture)
    steps = 0
    while trainer.state.preliminaries.scenes_left > 0:
        trainer.train_step()
        steps += 1
    assert steps == 2 * 2 + 2 * 16


@pytest.mark.parametrize(("scene", "fails"), [(1, "made"), (2, "joined")])
def test_a_scene_is_not_lost_where_memory_ends(
    tmp_path: Path, capture: Capture, monkeypatch: pytest.MonkeyPatch, scene: int, fails: str
) -> None:
    """Neither counted twice: what is saved is the scene at its end, and a resumed run goes on with the next."""
    trainer = toy_trainer(tmp_path, scenes_config(), capture)
    for _ in range(16 * scene - 1):
        trainer.train_step()

    def full(*arguments: Any, **settings: Any) -> None:
        raise MemoryError

    with monkeypatch.context() as patch:
        patch.setattr(NewScenes if fails == "made" else SceneStage, fails, full)
        with pytest.raises(UserError, match="memory"):
            trainer.train()
    assert trainer.step == 16
    assert len(trainer.state.preliminaries.kept_scenes) == scene - 1
    assert trainer.state.preliminaries.scenes_left == 3 - scene
    resumed = Trainer.resume(scenes_config(), capture, trainer.run)
    resumed.train()
    assert resumed.step == 20
    assert resumed.state.preliminaries.scenes_left == 0
    assert len(resumed.model.gaussians("shared")) > 2 * len(capture.points)


def test_a_damaged_scene_is_told(tmp_path: Path, capture: Capture) -> None:
    """A file from a stranger: what a scene lacks is said before anything is trained."""
    trainer = toy_trainer(tmp_path, scenes_config(), capture)
    for _ in range(17):
        trainer.train_step()
    path = trainer.save()
    state = load_checkpoint(path).state()
    del state["training"]["kept_scenes"][0]["shared"]["quats"]
    save_checkpoint(path, state)
    with pytest.raises(UserError, match="quats"):
        Trainer.resume(scenes_config(), capture, RunDirectory(tmp_path))


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_steps_must_be_left_for_what_they_become(share: float) -> None:
    """Without a share of the run at which rates begin to fall, there is no place to join scenes."""
    made = toy_run_config(20, scenes=2)
    config = dataclasses.replace(made, optimizer=dataclasses.replace(made.optimizer, cooldown_from=share))
    with pytest.raises(UserError, match=r"--scenes 2 become one at --optimizer\.cooldown-from"):
        check_config(config)
    check_config(dataclasses.replace(config, scenes=1))


def test_presets() -> None:
    """thermosplat_plus has two scenes; thermosplat_fast is one, with fewer steps. Both grow until rates fall."""
    plus, fast = in_steps(load_config("thermosplat_plus")), in_steps(load_config("thermosplat_fast"))
    assert (plus.scenes, fast.scenes) == (2, 1)
    for config, steps in ((plus, 4800), (fast, 3200)):
        assert steps_of_scene(config) == config.densification.stop_step == steps
    assert fast.steps_for_views is None


@pytest.mark.cuda
@pytest.mark.parametrize("graph", [True, False])
def test_scenes_become_one_on_a_device(tmp_path: Path, graph: bool) -> None:
    """As recorded steps, and line by line: the union is no worse than its scenes, and can be resumed."""
    capture = many_frames(toy_capture(), 9)
    config = scenes_config(200, device="cuda", graph=graph)
    trainer = toy_trainer(tmp_path / "one", config, capture)
    errors = {}
    trainer.logger.step = lambda record: errors.setdefault(  # type: ignore[method-assign]
        (len(trainer.state.preliminaries.kept_scenes), trainer.state.preliminaries.scenes_left, record.step),
        sum(float(value) for value in record.squared_errors.values()),
    )
    trainer.train()
    ends = {key[:2]: value for key, value in errors.items()}
    starts = [value for key, value in errors.items() if key[2] == 1]
    assert len(starts) == 2
    assert all(value > errors[0, 2, 160] for value in starts)
    assert (0, 0) in ends
    assert trainer.step == 200
    resumed = stopped_and_resumed(tmp_path / "two", config, capture, 120)
    resumed.train()
    assert resumed.step == 200
    assert resumed.state.preliminaries.scenes_left == 0
