"""A training on two devices in a real browser: it is seen, paused and stopped there."""

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

import headless_browser
from training_processes import training_process

PATIENCE = 60_000.0  # ms, on a busy machine
WORDS = (
    "sample --devices 2 --device cpu --data-factor 8 --max-steps 20000 --save-steps 20000 --eval-steps 20000 "
    "--log-every 100 --no-tensorboard --viewer 0 --result-dir"
)
"""Few lines: nobody reads them while the browser is at work, and a training whose pipe is full waits for its reader."""

pytestmark = headless_browser.MARKS


@pytest.fixture
def training(stoppable: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> "Iterator[subprocess.Popen[str]]":
    monkeypatch.setenv("COLUMNS", "200")
    with training_process(*WORDS.split(), tmp_path / "run") as process:
        yield process
        process.terminate()


def test_a_training_on_two_devices_is_paused_and_stopped(training: "subprocess.Popen[str]") -> None:
    """The page has pictures and the step; a pause lasts until it is stopped, and then all ranks end with one save."""
    assert training.stdout is not None
    lines = []
    for line in training.stdout:
        lines.append(line)
        if "The viewer:" in line or "step 200" in line:
            break
    url = next((line.split()[-1] for line in lines if "The viewer:" in line), None)
    assert url is not None, "".join(lines)
    next(line for line in training.stdout if line.startswith("step 200"))
    with headless_browser.browser() as browser:
        page = browser.new_page(viewport={"width": 600, "height": 400})
        page.set_default_timeout(PATIENCE)
        page.goto(url)
        page.get_by_role("tab", name="Training").click()
        page.get_by_role("button", name="Pause").click()
        page.get_by_text("paused at step").wait_for()
        page.wait_for_function("document.querySelector('#thermosplat-state').dataset.full === '1'")
        before = page.get_by_text("paused at step").inner_text()
        page.get_by_role("button", name="One step").click()
        page.wait_for_function("was => !document.body.innerText.includes(was)", arg=before)
        page.get_by_text("paused at step").wait_for()
        page.get_by_role("button", name="Save and stop").click()
        text = training.stdout.read()
    assert training.wait(timeout=60) == 130
    assert text.count("Stopped at step") == 1
