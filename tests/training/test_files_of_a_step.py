"""How many files of the project somebody reads who follows a training step."""

import sys
from pathlib import Path
from types import FrameType

import thermosplat
from thermosplat.config import DensificationConfig
from toy_run import many_frames, toy_run_config, toy_trainer
from toy_scene import toy_capture

MOST = 25
MOST_OF_TRAINING = 11


def test_a_training_step_enters_few_files(tmp_path: Path) -> None:
    """Once all frames were seen; the call of the renderer is one file, whatever that enters."""
    config = toy_run_config(40, densification=DensificationConfig(stop_step=0), log_every=100)
    trainer = toy_trainer(tmp_path, config, many_frames(toy_capture()))
    for _ in range(9):
        trainer.train_step()
    root, entered = Path(thermosplat.__file__).parent, set[Path]()

    def note(frame: FrameType, event: str, _: object) -> None:
        path = Path(frame.f_code.co_filename)
        if event == "call" and path.is_relative_to(root):
            entered.add(path.relative_to(root))

    sys.setprofile(note)
    try:
        trainer.train_step()
    finally:
        sys.setprofile(None)
    beyond = {path for path in entered if path.parts[0] in ("rasterizer", "torch_bridge")}
    assert Path("rasterizer/rgbt.py") in beyond
    assert len(entered - beyond) + 1 <= MOST, sorted(entered - beyond)
    assert sum(path.parts[0] == "training" for path in entered) <= MOST_OF_TRAINING
