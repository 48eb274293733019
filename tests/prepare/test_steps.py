"""Steps are done once, again when what they depend on has changed, and never taken for done when they were killed."""

from pathlib import Path

import pytest

from thermosplat.errors import UserError
from thermosplat.prepare.capture_folder import CaptureFolder
from thermosplat.prepare.steps import StepReport, require_step, run_step


class Work:
    """A step that counts how often it is done."""

    def __init__(self, capture: CaptureFolder, source: Path) -> None:
        self.capture, self.source, self.times, self.output = capture, source, 0, capture.root / "made"

    def __call__(self) -> list[str]:
        self.times += 1
        self.output.parent.mkdir(exist_ok=True)
        self.output.write_text("made")
        return [f"done {self.times}"]

    def run(self, **settings: object) -> StepReport:
        return run_step(self.capture, "sfm", self, settings=settings, inputs=[self.source], outputs=[self.output])


@pytest.fixture
def work(tmp_path: Path) -> Work:
    source = tmp_path / "source"
    source.write_text("one")
    return Work(CaptureFolder(tmp_path / "capture"), source)


def test_complete_step_is_not_done_again(work: Work) -> None:
    """It repeats what it said; another setting, input or a missing output has it done again."""
    assert work.run(size=(1, 2)) == StepReport(("done 1",))
    assert work.run(size=(1, 2)) == StepReport(("done 1",), before=True)
    assert work.run(size=(1, 3)) == StepReport(("done 2",))
    work.source.write_text("another")
    assert work.run(size=(1, 3)) == StepReport(("done 3",))
    work.output.unlink()
    assert work.run(size=(1, 3)) == StepReport(("done 4",))


def test_interrupted_step_is_not_complete(work: Work) -> None:
    """Neither when it failed the first time, nor when it had been complete with other settings."""
    work.run()
    require_step(work.capture, "sfm")

    def killed() -> list[str]:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_step(work.capture, "sfm", killed, settings={"other": 1}, inputs=[work.source])
    with pytest.raises(UserError, match="thermosplat-prepare sfm"):
        require_step(work.capture, "sfm")
    assert not work.run().before


def test_damaged_marker_is_none(work: Work) -> None:
    """A marker that is no JSON object does not count."""
    work.run()
    for content in ("{", "[]"):
        work.capture.marker("sfm").write_text(content)
        assert not work.run().before
