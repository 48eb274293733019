"""What a capture recommends for its training."""

from pathlib import Path

import pytest

from thermosplat.cli.arguments import parse_train_arguments
from thermosplat.config import TrainConfig
from thermosplat.config.capture_settings import with_recommendations
from thermosplat.errors import UserError

GOOD = "refine: [rig, intrinsics]\nspectra: {thermal: {exposure: level}}\n"


def test_between_preset_and_flags(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """They change the preset, a line says so, and flags win."""
    (tmp_path / "train.yaml").write_text(GOOD)
    config = parse_train_arguments([str(tmp_path)])
    assert (config.refine, config.spectra["thermal"].exposure) == (("rig", "intrinsics"), "level")
    assert "train.yaml are taken" in capsys.readouterr().out
    flags = ["--refine", "poses", "--thermal.exposure", "fixed"]
    config = parse_train_arguments([str(tmp_path), *flags])
    assert (config.refine, config.spectra["thermal"].exposure) == (("poses",), "fixed")


def test_without_the_file(tmp_path: Path) -> None:
    """Nothing changes."""
    preset = TrainConfig()
    for data in ("", "sample", str(tmp_path)):
        assert with_recommendations(preset, data) == (preset, None)


@pytest.mark.parametrize(
    ("text", "pattern"),
    [
        ("refine: [", "train.yaml cannot be read as YAML"),
        ("[]", "train.yaml"),
        ("result_dir: /elsewhere", "may have the settings refine and spectra only"),
        ("spectra: {thermal: {palette: /etc/passwd}}", "of thermal it may have exposure, unit, range only"),
        ("spectra: {nir: {unit: counts}}", "of a known spectrum"),
        ("refine: [everything]", "refine"),
    ],
)
def test_files_that_are_refused(tmp_path: Path, text: str, pattern: str) -> None:
    """Damage, and settings that a stranger's capture has no say in."""
    (tmp_path / "train.yaml").write_text(text)
    with pytest.raises(UserError, match=pattern):
        with_recommendations(TrainConfig(), str(tmp_path))
