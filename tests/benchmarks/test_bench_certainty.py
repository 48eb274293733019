"""What bench_certainty.py counts, and what it knows of captures whose scene it has."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bench_certainty import Pixels, rows_of
from rendered_captures.materials import matte, metal
from rendered_captures.paths import FLIP, look_at
from rendered_captures.scene_builder import LABELS, Builder
from thermosplat.datasets.cameras import Camera
from thermosplat.datasets.capture import View
from thermosplat.thermography.certainty import FEW_VIEWS, SMALL


def test_rows_are_those_of_their_pixels() -> None:
    """Shares of glass and of the rest; whether two images show it counts where it is known."""
    label = np.array([LABELS["glass"], 0, 0, 0])
    pixels = Pixels(
        error=np.array([0.1, -0.3, 0.1, 0.2]),
        half=np.full(4, 0.25),
        doubts=np.array([0, FEW_VIEWS, 0, SMALL]),
        label=label,
        seen=np.array([5, 1, 2, 8]),
    )
    rows = {row["label"]: row for row in rows_of("run", pixels)}
    assert rows["what reflects"]["shaded"] == rows["glass"]["shaded"] == 0
    assert rows["the rest"]["shaded"] == pytest.approx(2 / 3)
    assert rows["the rest"]["inside"] == pytest.approx(2 / 3)
    assert rows["the rest that two training images show"]["shaded"] == pytest.approx(1 / 2)
    assert rows["what is shaded"]["mean_error"] == pytest.approx(0.25)
    assert rows["what is not"]["mean_error"] == pytest.approx(0.1)
    assert "the rest that two training images show" not in {
        row["label"] for row in rows_of("run", pixels._replace(seen=np.full(4, -1)))
    }


def _frame(name: str, pose: np.ndarray, moved: np.ndarray) -> SimpleNamespace:
    """A photograph and a thermal image from one place, in a world that ``moved`` leads to."""
    to_world = moved @ pose @ FLIP
    to_world[:3, :3] /= np.cbrt(np.linalg.det(to_world[:3, :3]))
    viewmat, camera = np.linalg.inv(to_world), Camera(40.0, 40.0, 20.0, 15.0, 40, 30)
    thermal = View("thermal", f"IR_{name}", Path(), camera, viewmat, np.zeros((30, 40, 1), np.float32))
    photograph = replace(thermal, spectrum="rgb", name=f"VIS_{name}")
    return SimpleNamespace(views={"rgb": photograph, "thermal": thermal})


@pytest.mark.slow
def test_surfaces_are_found_from_another_world(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pane and a chrome ball before a wall have their labels; what they hide from others is seen less."""
    pytest.importorskip("mitsuba")
    from rendered_captures.rendering.start import start

    start("llvm_ad_rgb")
    from rendered_captures import true_surfaces
    from thermosplat.datasets.frame_tensors import view_tensors

    scene = Builder(np.random.default_rng(1))
    scene.box("wall", (0, 3, 1), (8, 0.1, 6), matte((200, 200, 200)), 21.0)
    scene.glass("pane", (-0.6, 1.5, 1), (0.6, 0.6), 22.0)
    scene.ball("chrome", (0.6, 1.5, 1), 0.3, metal("Cr"), 22.0, eps=0.1, mirror=0)
    places = [(x, -1.0, 1 + 0.1 * abs(x)) for x in (-1.0, -0.5, 0.0, 0.5, 1.0)]
    poses = [look_at(np.array(place), np.array((0, 3, 1.0))) for place in places]
    mount: Any = SimpleNamespace(scene=scene, poses=poses, photographs=[f"VIS_{k}.jpg" for k in range(5)])
    monkeypatch.setattr(true_surfaces, "mount_of", lambda name: mount)
    moved = np.eye(4)
    moved[:3, :3], moved[:3, 3] = 2.5 * np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]), (4, 5, 6)
    frames = [_frame(str(k), pose, moved) for k, pose in enumerate(poses)]
    capture: Any = SimpleNamespace(train=(*frames[:2], *frames[3:]), test=frames[2:3])
    surfaces = true_surfaces.TrueSurfaces("rig_desk", capture, "thermal")
    assert surfaces.cameras_off < 1e-9
    view = view_tensors(frames[2].views["thermal"], None, "cpu")
    label, seen = surfaces.labels(view), surfaces.seen(view)
    assert set(np.unique(label)) == {0, LABELS["glass"], LABELS["specular"]}
    assert (label[15, 14], label[15, 29], label[15, 20]) == (LABELS["glass"], LABELS["specular"], 0)
    assert seen[15, 14] == 4
    assert seen[15, 20] == 2  # of the wall's middle pane and ball hide each what one camera would see
