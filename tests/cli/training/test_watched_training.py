"""A training on two devices in a real browser: it is seen, paused and stopped there."""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
MISSING = [name for name in ("viser", "playwright") if find_spec(name) is None] + ([] if CHROMIUM else ["chromium"])
SOURCE = Path(__file__).parents[2] / "src"
PATIENCE = 60_000.0  # ms, on a busy machine
WORDS = (
    "sample --devices 2 --device cpu --data-factor 8 --max-steps 20000 --save-steps 20000 --eval-steps 20000 "
    "--log-every 1 --no-tensorboard --viewer 0 --result-dir"
)

pytestmark = [
    pytest.mark.browser,
    pytest.mark.slow,
    pytest.mark.skipif(bool(MISSING), reason=f"not installed: {', '.join(MISSING)}"),
]


@pytest.fixture
def training(tmp_path: Path) -> "Iterator[subprocess.Popen[str]]":
    path = os.pathsep.join([str(SOURCE), str(SOURCE.parent), os.environ.get("PYTHONPATH", "")])
    with subprocess.Popen(
        [sys.executable, "-m", "thermosplat", "train", *WORDS.split(), tmp_path / "run"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "PYTHONPATH": path, "COLUMNS": "200"},
    ) as process:
        yield process
        process.terminate()


@pytest.mark.parametrize("end", ["the button", "Ctrl-C"])
def test_a_training_on_two_devices_is_paused_and_stopped(training: "subprocess.Popen[str]", end: str) -> None:
    """The page has pictures and the step; a pause lasts until it is stopped, and then all ranks end with one save."""
    from playwright.sync_api import sync_playwright

    assert training.stdout is not None
    lines = []
    for line in training.stdout:
        lines.append(line)
        if "The viewer:" in line or "step 2" in line:
            break
    url = next((line.split()[-1] for line in lines if "The viewer:" in line), None)
    assert url is not None, "".join(lines)
    next(line for line in training.stdout if line.startswith("step 2"))
    with sync_playwright() as playwright:
        arguments = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=arguments)
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
        if end == "the button":
            page.get_by_role("button", name="Save and stop").click()
        else:
            training.send_signal(signal.SIGINT)
        text = training.stdout.read()
        browser.close()
    assert training.wait(timeout=60) == 130
    assert text.count("Stopped at step") == 1
