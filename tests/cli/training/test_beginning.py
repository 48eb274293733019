"""What a training does with its capture before the first step."""

import pytest

from thermosplat import datasets
from thermosplat.cli.training.beginning import capture_and_trainer
from thermosplat.config import TrainConfig
from thermosplat.prepare.checking import quick_check
from toy_scene import toy_capture


@pytest.mark.parametrize(("resume", "told"), [(None, ("poses are wrong",)), ("run", ())])
def test_what_is_probably_wrong_is_told_when_a_run_begins(
    resume: str | None, told: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run that goes on neither reduces the photographs again nor says it twice."""
    monkeypatch.setattr(datasets, "capture_of", lambda config: toy_capture())
    monkeypatch.setattr(quick_check, "quick_notes", lambda capture, spectra: ["poses are wrong"])
    capture, _ = capture_and_trainer(TrainConfig(data="capture", resume=resume))
    assert capture.notes == told
