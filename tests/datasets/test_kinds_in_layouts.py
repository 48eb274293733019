"""Labels and stacks beside photographs, in every layout."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from capture_folders import HEIGHT, WIDTH, spectra_with, write_colmap_folder, write_image, write_rgbt_scenes, write_rig
from capture_folders import write_transforms as write_thermoscenes
from thermosplat.datasets import load_capture
from thermosplat.errors import UserError
from thermosplat.prepare.checking.quick_check import quick_findings
from thermosplat.spectra import LATENT

SPECTRA = spectra_with(
    parts={"source": "labels", "classes": ("wall", "window")},
    maps={"source": "features", "channels": 20, "aligned": True},
    thermal={"source": "auto"},
)


@pytest.mark.parametrize("write", [write_rgbt_scenes, write_colmap_folder, write_rig, write_thermoscenes])
def test_files_are_found_by_the_photographs_names(tmp_path: Path, write: Callable[[Path], object]) -> None:
    """Label images as large as photographs, and feature maps of a quarter of their sides."""
    write(tmp_path)
    rng = np.random.default_rng(0)
    for path in sorted(path for path in tmp_path.rglob("*") if path.parts[len(tmp_path.parts)] in ("rgb", "images")):
        if path.is_file() and path.parent.name != "thermal":
            below = path.relative_to(tmp_path).with_suffix("").parts[1:]
            below = tuple(part for part in below if part != "rgb")
            write_image(tmp_path.joinpath("parts", *below).with_suffix(".png"), np.ones((HEIGHT, WIDTH), np.uint8))
            maps = tmp_path.joinpath("maps", *below).with_suffix(".npy")
            maps.parent.mkdir(parents=True, exist_ok=True)
            np.save(maps, rng.normal(size=(HEIGHT // 2, WIDTH // 2, 20)))
    capture = load_capture(tmp_path, spectra=SPECTRA)
    assert not [one for one in quick_findings(capture, SPECTRA) if "parts" in one.sentence or "maps" in one.sentence]
    frames = [frame for frame in (*capture.train, *capture.test) if "rgb" in frame.views]
    assert frames
    assert {name: scale.kind for name, scale in capture.scales.items() if name in ("parts", "maps")} == {
        "parts": "labels",
        "maps": "stack",
    }
    for frame in frames:
        view, maps = frame.views["parts"], frame.views["maps"]
        assert view.image is not None
        assert maps.image is not None
        assert set(map(tuple, view.image.reshape(-1, 3).tolist())) == {(128, 0, 0)}
        assert maps.image.shape == (HEIGHT // 2, WIDTH // 2, LATENT + 1)
        np.testing.assert_allclose(maps.camera.fx, frame.views["rgb"].camera.fx / 2)


def test_stacks_do_not_stay_on_the_disk(tmp_path: Path) -> None:
    """Of a capture that is larger than memory they are refused, in a sentence that says how to go on."""
    write_rgbt_scenes(tmp_path)
    with pytest.raises(UserError, match=r"maps \(features\) cannot stay on the disk"):
        load_capture(tmp_path, spectra=SPECTRA, image_memory=1e-6)
