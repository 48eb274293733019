"""What a training does with its capture before the first step."""

import pytest

from thermosplat import datasets
from thermosplat.cli.arguments import parse_train_arguments
from thermosplat.cli.training.beginning import capture_and_trainer
from thermosplat.config import TrainConfig
from thermosplat.prepare.checking import quick_check
from thermosplat.prepare.checking.findings import Finding
from toy_scene import toy_capture

WRONG_POSES = Finding("warning", "poses are wrong", {"refine": ["poses"]})
DARK = Finding("warning", "exposures differ", {"spectra": {"rgb": {"exposure": "affine"}}})


@pytest.mark.parametrize(("resume", "told"), [(None, ("poses are wrong",)), ("run", ())])
def test_what_is_probably_wrong_is_told_when_a_run_begins(
    resume: str | None, told: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run that goes on neither reduces the photographs again nor says it twice."""
    monkeypatch.setattr(datasets, "capture_of", lambda config: toy_capture())
    monkeypatch.setattr(quick_check, "quick_findings", lambda *what: [WRONG_POSES])
    _, capture, _ = capture_and_trainer(["capture"], TrainConfig(data="capture", resume=resume))
    assert capture.notes == told


@pytest.mark.parametrize(
    ("flags", "refine", "exposure"),
    [
        ([], ("poses",), "affine"),
        (["--refine", "rig", "--rgb.exposure", "fixed"], ("rig",), "fixed"),
        (["--refine"], (), "affine"),
    ],
)
def test_what_images_recommend_is_done_where_the_command_says_nothing_else(
    flags: list[str],
    refine: tuple[str, ...],
    exposure: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """And is said, with the names of the settings."""
    monkeypatch.setattr(datasets, "capture_of", lambda config: toy_capture())
    monkeypatch.setattr(quick_check, "quick_findings", lambda *what: [WRONG_POSES, DARK])
    argv = ["capture", *flags]
    config, _, _ = capture_and_trainer(argv, parse_train_arguments(argv))
    assert (config.refine, config.spectra["rgb"].exposure) == (refine, exposure)
    assert ("refine poses" in capsys.readouterr().out) == (refine == ("poses",))
