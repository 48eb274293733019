"""How fast does the viewer make a picture, and how soon is there a first one?

    python benchmarks/bench_viewer.py results/sample/demo --sizes 320x180 640x360 1280x720
    python benchmarks/bench_viewer.py results/shed/thermosplat --device cuda --sizes 1280x720 --json viewer.json

Each part of a picture is timed apart: the traversal of the Gaussians ("render"), the decoders, the values behind
pseudo-colours (a picture at rest has them, a moving one needs none), palette and copy to the host ("display"), and
JPEG. The camera moves from frame to frame, so that nothing is known from the picture before. The first lines say when
the first picture was there, counted from the start of this process. README.md says more.
"""

import argparse
import json
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path
from statistics import median
from typing import Any

STARTED = time.perf_counter()

from thermosplat.cli.host_settings import importing, prepare_host  # noqa: E402  the clock runs

prepare_host()
with importing():
    import cv2
    import torch
    from torch import Tensor

    from thermosplat.novel_views.bookmarks import Bookmark
    from thermosplat.runs.atomic_writes import write_text
    from thermosplat.runs.environment import environment
    from thermosplat.viewer.layers import Layer, LayerRenderer, available_layers, image_layer
    from thermosplat.viewer.opening import open_scene
    from thermosplat.viewer.pace import Pace
    from thermosplat.viewer.session import ViewSession
    from thermosplat.viewer.turns import OneAtATime
    from thermosplat.viewer.viewed_scene import ViewedScene, frame_bookmark
    from thermosplat.viewer.visitor import MOVING_QUALITY
    from thermosplat.viewer.wish import start_wish

IMPORTED = time.perf_counter()
PARTS = ("render", "decode", "values", "display", "jpeg")
WARM_UP = 2


class Stopwatch:
    """Seconds by part of a picture; waits for the device at both ends of each.

    Args:
        device: Where the model is.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.seconds: dict[str, float] = {}

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Around a part; further times of one name are added."""
        self._wait()
        started = time.perf_counter()
        yield
        self._wait()
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started

    def _wait(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)


def first_picture(named: str, device: str) -> tuple[ViewedScene, dict[str, float]]:
    """Open a scene and make the first, small picture; the seconds since the start of the process at each point."""
    scene, _, _ = open_scene(named, device=device)
    opened = time.perf_counter()
    session = ViewSession(LayerRenderer(scene), OneAtATime(), start_wish(available_layers(scene)))
    shown = session.render(scene.start(), *Pace().size(1280, 720), full=False)
    encode(shown.picture)
    points = {"imported": IMPORTED, "opened": opened, "first picture": time.perf_counter()}
    return scene, {name: at - STARTED for name, at in points.items()}


def encode(picture: Any) -> int:
    """Bytes of a picture as the viewer sends it while the camera moves."""
    return len(cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, MOVING_QUALITY])[1])


@torch.no_grad()
def one_picture(renderer: LayerRenderer, layer: Layer, view: Bookmark, size: tuple[int, int]) -> dict[str, float]:
    """Seconds of each part of one picture."""
    scene = renderer.scene
    watch, model = Stopwatch(scene.device), scene.model
    plain = model.formations.decode

    def timed(features: Mapping[str, Tensor]) -> dict[str, Tensor]:
        with watch.part("decode"):
            return {} if plain is None else plain(features)

    with nullcontext() if plain is None else model.formations.decoding_by(timed), watch.part("whole"):
        tensors = scene.view(view.viewmat, view.fov_y, *size)
        image = model.render({layer.spectrum: tensors}, sh_degree=scene.sh_degree).images[layer.spectrum]
    watch.seconds["render"] = watch.seconds.pop("whole") - watch.seconds.get("decode", 0.0)
    scale = scene.scales[layer.spectrum]
    with watch.part("values"):
        image_layer(layer, image, scale, values=True)
    session = ViewSession(renderer, OneAtATime(), start_wish([layer]))
    with watch.part("display"):
        picture = session.display(layer).picture(image_layer(layer, image, scale, values=False))
    with watch.part("jpeg"):
        encode(picture)
    if scale.kind == "photograph":
        watch.seconds["values"] = 0.0
    return watch.seconds


def measured(renderer: LayerRenderer, layer: Layer, size: tuple[int, int], repeats: int) -> dict[str, float]:
    """Medians of the parts [ms], and the pictures a second of a moving camera."""
    scene = renderer.scene
    frames = [frame for frame in scene.frames if layer.spectrum in frame.views]
    views = [frame_bookmark(frame, layer.spectrum) for frame in frames] or [scene.start()]
    runs = [one_picture(renderer, layer, views[n % len(views)], size) for n in range(WARM_UP + repeats)][WARM_UP:]
    times = {part: 1000 * median(run.get(part, 0.0) for run in runs) for part in PARTS}
    moving = sum(times[part] for part in PARTS if part != "values")
    return {**times, "moving": moving, "per_second": 1000 / moving}


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", help="a run, a checkpoint or a PLY file")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--sizes", nargs="+", default=["320x180", "640x360", "1280x720"])
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()

    scene, points = first_picture(arguments.scene, arguments.device)
    for name, seconds in points.items():
        print(f"{name:<16} {seconds:6.2f} s after the start of the process")
    renderer, rows = LayerRenderer(scene), []
    print(f"\n{'layer':<10} {'size':>10}  " + "  ".join(f"{part:>8}" for part in PARTS) + "    moving  per second")
    for size in arguments.sizes:
        width, _, height = size.partition("x")
        for layer in [layer for layer in available_layers(scene) if layer.kind == "image"]:
            times = measured(renderer, layer, (int(width), int(height)), arguments.repeats)
            rows.append({"layer": layer.label, "size": size, **times})
            cells = "  ".join(f"{times[part]:8.1f}" for part in PARTS)
            print(
                f"{layer.label:<10} {size:>10}  {cells}  {times['moving']:8.1f}  {times['per_second']:10.1f}",
                flush=True,
            )
    print("\nTimes in ms, medians. A picture at rest also takes the values.")
    if arguments.json is not None:
        report = {"environment": environment(scene.device), "first_picture": points, "rows": rows}
        write_text(arguments.json, json.dumps(report, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
