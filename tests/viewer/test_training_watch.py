"""What viewers ask of a training is done between its steps; its curves are read as they grow."""

import json
import threading
from pathlib import Path

import pytest

from thermosplat.viewer.training_watch import Curves, TrainingWatch, is_loss, is_psnr
from viewed_toy import viewed_toy


class Training:
    """Counts its steps."""

    def __init__(self) -> None:
        self.step, self.sh_degree, self.saved = 0, 2, 0

    def save(self) -> Path:
        self.saved = self.step
        return Path(f"step_{self.step}.pt")

    def go(self, watch: TrainingWatch, steps: int) -> None:
        for _ in range(steps):
            self.step += 1
            watch.between_steps(self)


@pytest.fixture
def watch(tmp_path: Path) -> TrainingWatch:
    made = TrainingWatch(viewed_toy(), 100, tmp_path / "metrics.jsonl")
    made.has_viewers = lambda: True
    return made


def test_a_paused_training_renders_and_steps(watch: TrainingWatch) -> None:
    """While it waits renders are done at once, one step is one step, and going on goes on."""
    training = Training()
    watch.pause(True)
    thread = threading.Thread(target=training.go, args=(watch, 5), daemon=True)
    thread.start()
    assert watch.turns.run(lambda: training.step) == 1
    assert watch.turns.run(lambda: training.step) == 1
    watch.do_step()
    for _ in range(100):
        if watch.turns.run(lambda: training.step) == 2:
            break
    assert watch.turns.run(lambda: training.step) == 2
    watch.save()
    for _ in range(100):
        if watch.turns.run(lambda: training.saved) == 2:
            break
    assert training.saved == 2
    assert "step_2.pt" in watch.message
    watch.pause(False)
    thread.join(10)
    assert training.step == 5
    assert watch.scene.sh_degree == 2


def test_a_training_that_nobody_watches_goes_on(watch: TrainingWatch) -> None:
    """When the last tab is closed while it waits, it does not wait for ever."""
    watch.pause(True)
    training = Training()
    thread = threading.Thread(target=training.go, args=(watch, 3), daemon=True)
    thread.start()
    watch.turns.run(lambda: None)
    watch.has_viewers = lambda: False
    thread.join(10)
    assert training.step == 3


def test_stopping_is_an_interrupt(watch: TrainingWatch) -> None:
    """As Ctrl-C: the trainer saves and ends."""
    watch.stop()
    with pytest.raises(KeyboardInterrupt):
        Training().go(watch, 5)


def test_curves_grow_with_their_file(tmp_path: Path) -> None:
    """Whole lines only, evaluations and rubbish left out, and a file that begins anew is read anew."""
    path = tmp_path / "metrics.jsonl"
    curves = Curves(path)
    assert curves.read() == []
    line = {"step": 5, "loss": 0.5, "rgb_l1": 0.2, "psnr_rgb": 20.0, "psnr_thermal": None, "num_gaussians": 7}
    path.write_text(json.dumps(line) + "\n" + json.dumps({"step": 5, "held_out": {}}) + '\nrubbish\n{"step": 10, ')
    assert curves.read() == [line]
    with path.open("a") as file:
        file.write('"loss": 0.25}\n')
    curves.read()
    steps, psnr = curves.series(is_psnr)
    assert steps == [5, 10]
    assert psnr["psnr_rgb"][0] == 20.0
    assert str(psnr["psnr_thermal"]) == "[nan, nan]"
    assert set(curves.series(is_loss)[1]) == {"loss", "rgb_l1"}
    path.write_text(json.dumps({"step": 1, "loss": 1.0}) + "\n")
    assert [entry["step"] for entry in curves.read()] == [1]
