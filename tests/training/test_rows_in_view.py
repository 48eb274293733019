"""Trainings whose parameters lie in the host's memory: what they do as others do, and what stays as it is."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch

from thermosplat.config import DensificationConfig
from thermosplat.datasets.capture import Capture
from thermosplat.fused.row_adam import RowAdam
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.scene.gaussians import Gaussians
from thermosplat.scene.offloaded import OffloadedParameter
from thermosplat.torch_bridge.host_rows import has_padded_rows
from thermosplat.training.density import decomposition
from thermosplat.training.optimizers import gradients_to_watch
from thermosplat.training.step_kind import StepKind
from thermosplat.training.trainer import Trainer
from toy_run import many_frames, state_tensors, step_gradients, toy_run_config, toy_trainer
from toy_scene import toy_capture

KINDS = ["moments", "on", "on, some moments on the device"]
MCMC = DensificationConfig(strategy="mcmc", start_step=2, stop_step=50, every=3, max_gaussians=90, growth=0.1)
SETTINGS: dict[str, dict[str, Any]] = {
    "default": {},
    "mcmc": {"densification": MCMC},
    "separate": {"model": {"gaussian_sets": "separate", "feature_dim": 0}},
    "no features": {"model": {"feature_dim": 0}},
    "decomposing": {
        "spectra": {"thermal": {"opacity": "own"}},
        "model": {"feature_dim": 0},
        "densification": DensificationConfig(
            strategy="decomposing", start_step=2, stop_step=50, every=3, reset_every=3000, max_gaussians=600
        ),
    },
}


@pytest.fixture(autouse=True)
def _much_is_divided(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decomposition, "CONFLICT_THRESHOLD", 1e-6)


def capture_of(aligned: bool = True) -> Capture:
    """A few frames that all see all Gaussians."""
    return many_frames(toy_capture(aligned=aligned))


def trained(path: Path, steps: int, *, aligned: bool = True, **settings: Any) -> Trainer:
    """A trainer after some steps."""
    kind, _, some = settings.pop("offload", "off").partition(", ")
    trainer = toy_trainer(path, toy_run_config(**settings, offload=kind), capture_of(aligned))
    if some:
        for optimizer in (one for name in trainer.state.gaussian_sets for one in trainer.state.row_optimizers(name)):
            optimizer.rows_on_device = 25
    while trainer.step < steps:
        trainer.train_step()
    return trainer


def is_offloaded(gaussians: Gaussians) -> bool:
    """Whether steps use rows of the set's harmonics, and not all of them."""
    return isinstance(gaussians.get_parameter("shN"), OffloadedParameter)


def close_states(one: Trainer, other: Trainer, tolerance: float = 1e-4) -> None:
    """Two states hold the same tensors, and the same numbers to rounding and what training makes of it."""
    found, expected = state_tensors(one), state_tensors(other)
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value, rtol=1e-2, atol=tolerance, msg=name)


@pytest.mark.rotating
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("aligned", [True, False])
@pytest.mark.parametrize("settings", SETTINGS.values(), ids=SETTINGS)
def test_trains_as_others_where_all_is_in_view(
    tmp_path: Path, settings: dict[str, Any], aligned: bool, kind: str
) -> None:
    """Four steps with a refinement: the same numbers of Gaussians, parameters, moments and observations."""
    plain = trained(tmp_path / "plain", 4, aligned=aligned, **settings)
    offloaded = trained(tmp_path / "offloaded", 4, aligned=aligned, **settings, offload=kind)
    assert all(map(is_offloaded, offloaded.state.gaussian_sets.values()))
    assert not any(map(is_offloaded, plain.state.gaussian_sets.values()))
    for name, gaussians in plain.state.gaussian_sets.items():
        assert len(offloaded.state.gaussian_sets[name]) == len(gaussians)
    close_states(offloaded, plain)


def test_what_is_out_of_view_stays(tmp_path: Path) -> None:
    """Gaussians behind all cameras: their offloaded numbers and moments wait, while Adam moves the others'."""
    trainer = trained(tmp_path, 1, offload="on", sh_degree_interval=1, densification=DensificationConfig(stop_step=0))
    gaussians, optimizers = trainer.state.gaussian_sets["shared"], trainer.state.optimizers["shared"]
    trainer.train_step()  # now there are moments
    with torch.no_grad():
        gaussians.means[::2, 2] -= 100.0
    held = [*(gaussians.get_parameter(name) for name in ("shN", "features"))]
    held += [optimizers[name].state[value]["exp_avg"] for name, value in zip(("shN", "features"), held, strict=True)]
    before = [value.detach().clone() for value in held]
    for _ in range(3):
        trainer.train_step()
    for value, previous in zip(held, before, strict=True):
        assert torch.equal(value[::2], previous[::2])
        assert (value[1::2] != previous[1::2]).any()
    assert optimizers["features"].state[held[1]]["step"] == 5


@pytest.mark.rotating
@pytest.mark.parametrize(("first", "then"), [("on", "off"), ("off", "on"), ("moments", "on"), (KINDS[2], "on")])
def test_resumes_with_and_without(tmp_path: Path, first: str, then: str) -> None:
    """A checkpoint is the same file: what goes on from it ends where it would have ended otherwise."""
    config = toy_run_config(max_steps=6)
    whole = trained(tmp_path / "whole", 6, max_steps=6)
    half = trained(tmp_path / "half", 4, max_steps=6, offload=first)
    half.run.write_config(half.recipe.asked)
    half.save()
    resumed = Trainer.resume(dataclasses.replace(config, offload=then), capture_of(), RunDirectory.open(half.run.path))
    assert is_offloaded(resumed.state.gaussian_sets["shared"]) == (then == "on")
    while resumed.step < 6:
        resumed.train_step()
    close_states(resumed, whole)


@pytest.mark.rotating
@pytest.mark.parametrize("kind", KINDS)
def test_a_whole_run(tmp_path: Path, kind: str) -> None:
    """Training, evaluation, a budget's removals and export: the same counts and nearly the same metrics."""
    found = {}
    for offload in ("off", kind):
        trainer = trained(tmp_path / offload, 0, max_steps=12, offload=offload, budget="auto", eval_steps=(5,))
        found[offload] = trainer.train()
        assert (tmp_path / offload / "ply" / "splat_rgb.ply").is_file()
    for name in ("rgb", "thermal"):
        assert found[kind][name]["psnr"] == pytest.approx(found["off"][name]["psnr"], abs=0.05)


@pytest.mark.parametrize("kind", KINDS)
def test_refinements_keep_rows_where_they_lie(tmp_path: Path, kind: str) -> None:
    """After growth parameters are still offloaded, each with an optimizer of rows; a new start keeps that too."""
    trainer = trained(tmp_path, 7, offload=kind)

    def check() -> None:
        gaussians, optimizers = trainer.state.gaussian_sets["shared"], trainer.state.optimizers["shared"]
        for name, parameter in gaussians.named_parameters():
            offloaded = isinstance(parameter, OffloadedParameter)
            assert offloaded == (name in ("shN", "features"))
            assert offloaded == isinstance(optimizers[name], RowAdam)
            assert not offloaded or parameter.on_host == (kind != "moments")
            assert name != "shN" or has_padded_rows(parameter) == (kind != "moments")
            assert optimizers[name].param_groups[0]["params"][0] is parameter

    assert len(trainer.state.gaussian_sets["shared"]) > 60
    check()
    trainer.beginnings.forget_scene()
    assert len(trainer.state.gaussian_sets["shared"]) == 60
    check()


def test_an_interrupted_step_leaves_no_rows(tmp_path: Path) -> None:
    """Rows of a step that was not done are not updated by the next one, and gradients of rows are watched."""
    trainer = trained(tmp_path, 1, offload="on")
    optimizers = trainer.state.optimizers["shared"]
    kind = StepKind(1, densifying=True)
    done = step_gradients(trainer, kind)
    assert done.observed is not None
    rows = optimizers["features"].rows
    assert rows is not None
    watched = gradients_to_watch(trainer.state.optimizers)
    assert watched["shared features"] == [rows.values.grad]
    assert "shared shN" not in watched
    trainer.state.clear_gradients()
    assert optimizers["features"].rows is None
