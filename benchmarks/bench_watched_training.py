"""What does a viewer cost a training?

    python benchmarks/bench_watched_training.py sample --device cpu --window 40 --rounds 5 -- --config demo
    python benchmarks/bench_watched_training.py captures/yard --device cuda --json watched.json

One training, in windows of so many steps that take turns: without the viewer's hook; with it, and nobody watching; and
with a viewer that wants a picture of a moving camera all the time, and encodes it as JPEG. Prints the steps per second
of each, and what share of the speed watching takes: the median over pairs of rounds. What follows ``--`` are flags of
thermosplat-train. The browser and the connection are not in it. README.md says more.
"""

import argparse
import json
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from itertools import cycle
from pathlib import Path
from statistics import median
from typing import Any

from thermosplat.cli.arguments import parse_train_arguments
from thermosplat.cli.host_settings import prepare_host

prepare_host()

import cv2  # noqa: E402
import torch  # noqa: E402

from thermosplat.datasets import load_capture  # noqa: E402
from thermosplat.runs.atomic_writes import write_text  # noqa: E402
from thermosplat.runs.environment import environment  # noqa: E402
from thermosplat.training.trainer import Trainer  # noqa: E402
from thermosplat.viewer.layers import LayerRenderer, available_layers  # noqa: E402
from thermosplat.viewer.session import ViewSession  # noqa: E402
from thermosplat.viewer.training_watch import TrainingWatch  # noqa: E402
from thermosplat.viewer.turns import ViewingEnded  # noqa: E402
from thermosplat.viewer.viewed_scene import ViewedScene, frame_bookmark  # noqa: E402
from thermosplat.viewer.visitor import MOVING_QUALITY  # noqa: E402
from thermosplat.viewer.wish import start_wish  # noqa: E402
from training.command import apart  # noqa: E402
from training.frozen_training import quiet_trainer  # noqa: E402

KINDS = ("alone", "nobody watches", "watched")


class EnoughMeasured(Exception):
    """Ends the training."""


class Windows:
    """Steps in windows of each kind by turns, and how long they took.

    Before the first window pictures are taken whenever one is asked for, which loads their kernels.

    Args:
        watch: What a viewer's hook does.
        device: Where the training is.
        window: Steps of a window.
        first: Steps before the first window.
        rounds: Windows of each kind.
    """

    def __init__(self, watch: TrainingWatch, device: torch.device, window: int, first: int, rounds: int) -> None:
        self.watch, self.device, self.window, self.first, self.rounds = watch, device, window, first, rounds
        self.seconds: dict[str, list[float]] = {kind: [] for kind in KINDS}
        self.kind = KINDS[2]
        self._share, watch.turns.share = watch.turns.share, 1.0
        self._since = 0.0

    def between_steps(self, trainer: Trainer) -> None:
        """The trainer's hook."""
        if self.kind != KINDS[0]:
            self.watch.between_steps(trainer)
        done = trainer.step - self.first
        if done < 0 or done % self.window:
            return
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        now = time.perf_counter()
        if done:
            self.seconds[self.kind].append(now - self._since)
        self.watch.turns.share = self._share
        if all(len(found) == self.rounds for found in self.seconds.values()):
            raise EnoughMeasured
        turn, place = divmod(done // self.window, len(KINDS))
        # the scene grows: two rounds together are as far along for each kind
        self.kind = KINDS[place if turn % 2 == 0 else -1 - place]
        self._since = time.perf_counter()


def keep_looking(
    session: ViewSession, scene: ViewedScene, size: tuple[int, int], windows: Windows
) -> Callable[[], int]:
    """Ask for pictures of a moving camera in windows that are watched. What is returned says how many there were.

    Those before the first window are not among them.
    """
    name = next(iter(scene.model.spectra))
    views = cycle([frame_bookmark(frame, name) for frame in scene.frames if name in frame.views])
    count = 0

    def look() -> None:
        nonlocal count
        while True:
            if windows.kind != KINDS[2]:
                time.sleep(0.002)
                continue
            try:
                shown = session.render(next(views), *size, full=False)
            except ViewingEnded:
                return
            cv2.imencode(".jpg", shown.picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, MOVING_QUALITY])
            count += bool(windows.seconds[KINDS[0]])  # the first timed window is one of those alone

    threading.Thread(target=look, daemon=True).start()
    return lambda: count


def main() -> None:
    """Measure and print."""
    words, flags = apart(sys.argv[1:])
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", help="folder of a capture, or sample")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--size", default="640x360", help="of the pictures [px]")
    parser.add_argument("--warm-up", type=int, default=100, help="steps before the first window")
    parser.add_argument("--window", type=int, default=200, help="steps of a window")
    parser.add_argument("--rounds", type=int, default=8, help="windows of each kind, even")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args(words)
    if arguments.rounds < 2 or arguments.rounds % 2:
        parser.error(f"--rounds must be even, got {arguments.rounds}: the second of two goes the other way round")
    width, _, height = arguments.size.partition("x")
    steps = arguments.warm_up + len(KINDS) * arguments.rounds * arguments.window + 1
    config = parse_train_arguments([arguments.data, "--device", arguments.device, "--max-steps", str(steps), *flags])
    capture = load_capture(config.data, data_factor=config.data_factor, spectra=config.spectra)
    with tempfile.TemporaryDirectory() as folder:
        trainer = quiet_trainer(config, capture, Path(folder) / "run")
        scales = {name: capture.scales[name] for name in trainer.model.spectra}
        scene = ViewedScene(capture.name, trainer.model, trainer.sh_degree, scales, trainer.device, capture)
        watch = TrainingWatch(scene, config.max_steps, trainer.run.metrics_jsonl)
        windows = Windows(watch, trainer.device, arguments.window, arguments.warm_up, arguments.rounds)
        watch.has_viewers = lambda: windows.kind == KINDS[2]
        session = ViewSession(LayerRenderer(scene), watch.turns, start_wish(available_layers(scene)))
        pictures = keep_looking(session, scene, (int(width), int(height)), windows)
        trainer.between_steps = windows.between_steps
        try:
            trainer.train()
        except EnoughMeasured:
            pass
        finally:
            watch.turns.end()
    report = summary(windows, pictures())
    print(f"{'':<16} {'steps/s':>9}  {'of the speed alone':>18}")
    for kind in KINDS:
        print(f"{kind:<16} {report[kind]['steps_per_second']:9.1f}  {report[kind]['share']:18.1%}")
    print(f"{report['pictures_per_second']:.1f} pictures of {arguments.size} per second while watched")
    if arguments.json is not None:
        report = {"environment": environment(trainer.device), **report}
        write_text(arguments.json, json.dumps(report, indent=1) + "\n")


def summary(windows: Windows, pictures: int) -> dict[str, Any]:
    """Steps per second of each kind, and the median over pairs of rounds of the share of the speed alone."""
    paired = {
        kind: [sum(pair) for pair in zip(found[::2], found[1::2], strict=True)]
        for kind, found in windows.seconds.items()
    }
    report: dict[str, Any] = {
        kind: {
            "steps_per_second": 2 * windows.window / median(paired[kind]),
            "share": median(one / other for one, other in zip(paired[KINDS[0]], paired[kind], strict=True)),
            "seconds": found,
        }
        for kind, found in windows.seconds.items()
    }
    return {**report, "pictures_per_second": pictures / sum(windows.seconds[KINDS[2]])}


if __name__ == "__main__":
    main()
