"""A run, a checkpoint and a PLY file open as scenes; what is something else ends with a sentence."""

import os
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from thermosplat.cli import view
from thermosplat.errors import UserError
from thermosplat.viewer import front_end
from thermosplat.viewer.layers import Layer, LayerRenderer, available_layers
from thermosplat.viewer.opening import open_scene
from toy_run import many_frames, toy_run_config, toy_trainer
from toy_scene import toy_capture


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of three steps, whose capture lies nowhere."""
    path = tmp_path_factory.mktemp("runs") / "toy"
    toy_trainer(path, toy_run_config(3, data="gone/toy"), many_frames(toy_capture())).train()
    return path


def test_a_run_without_its_photographs_opens(run: Path) -> None:
    """Everything but photographs and errors is there, and a note says where to look for the capture."""
    scene, folder, notes = open_scene(str(run), device="cpu")
    assert {layer.kind for layer in available_layers(scene)} == {"image", "depth", "opacity", "offset", "features"}
    assert folder == run / "measurements"
    assert any("No photographs are shown" in note and "--data FOLDER" in note for note in notes)
    assert scene.name == "toy, step 3"
    with pytest.raises(UserError, match="elsewhere"):
        open_scene(str(run), device="cpu", data="elsewhere")


def test_a_checkpoint_is_its_run_at_that_step(run: Path, tmp_path: Path) -> None:
    """In the run's folder or copied out of it, its image is the run's."""
    (file,) = (run / "ckpts").glob("*.pt")
    lone = tmp_path / "lone.pt"
    shutil.copy(file, lone)
    layer = Layer("image", "thermal")
    images = []
    for named in (run, file, lone):
        scene, folder, _ = open_scene(str(named), device="cpu")
        start = scene.start()
        camera = scene.view(start.viewmat, start.fov_y, 24, 18)
        images.append(LayerRenderer(scene).render([layer], camera)[layer].field)
        assert folder == (tmp_path if named == lone else run) / "measurements"
    np.testing.assert_array_equal(images[0], images[1])
    np.testing.assert_array_equal(images[0], images[2])


def test_a_ply_file_of_a_run_opens(run: Path) -> None:
    """Its measurements lie beside it."""
    scene, folder, notes = open_scene(str(run / "ply" / "splat_thermal.ply"), device="cpu")
    assert (folder, notes) == (run / "ply" / "splat_thermal_measurements", [])
    assert scene.model.num_gaussians > 0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["{run}/none.pt"], "There is no checkpoint"),
        (["{run}/none.ply"], "Cannot read"),
        (["scene.SPZ"], "is a file for other programs, which thermosplat-view does not read"),
        (["{run}/ply"], "No training run in"),
        (["{run}/config.yaml"], "No training run in"),
        (["{run}", "--port", "70000"], "--port must lie between 0 and 65535"),
        (["{run}", "--step", "7"], "no checkpoint of step 7"),
        (["{file}", "--step", "3"], "is one checkpoint, and --step chooses one of a run"),
    ],
)
def test_mistakes_end_with_a_sentence(
    run: Path, words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit code 2, and what is wrong."""
    (file,) = (run / "ckpts").glob("*.pt")
    assert view.main([word.format(run=run, file=file) for word in words]) == 2
    message = " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert said in message


@pytest.mark.parametrize("ended", [True, False])
def test_ctrl_c_waits_for_no_picture(run: Path, ended: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where one is still being rendered the process ends at once, with the same code: Python would abort under it."""

    def interrupted() -> None:
        raise KeyboardInterrupt

    def leave(code: int) -> None:
        raise SystemExit(f"at once, {code}")

    monkeypatch.setattr(view, "threading", SimpleNamespace(Event=lambda: SimpleNamespace(wait=interrupted)))
    monkeypatch.setattr(front_end, "Viewer", lambda *a, **k: SimpleNamespace(url="", stop=lambda: ended))
    monkeypatch.setattr(os, "_exit", leave)
    if ended:
        assert view.main([str(run), "--device", "cpu"]) == 130
        return
    with pytest.raises(SystemExit, match="at once, 130"):
        view.main([str(run), "--device", "cpu"])
