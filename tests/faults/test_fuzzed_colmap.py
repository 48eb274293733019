"""Changed COLMAP models: a capture, or one sentence."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from capture_folders import rgb_image, synthetic_model, write_image
from fuzzing import Fuzzer, changed_bytes, main, number_of_cases, run_apart
from thermosplat.datasets import load_capture

COUNT = 4


def make(root: Path) -> Fuzzer:
    """Models of one and of two cameras, binary and text, with rigs and as COLMAP wrote them before it had rigs."""
    models = []
    for cameras in (1, 2):
        for lens in ("PINHOLE", "SIMPLE_RADIAL"):
            params = (40.0, 42.0, 16.0, 12.0) if lens == "PINHOLE" else (40.0, 16.0, 12.0, 0.05)
            model = synthetic_model(COUNT, cameras=cameras, camera_model=lens, params=params)
            for image in model.images.values():
                for folder in ("images", ".") if cameras == 2 else ("images", "thermal"):
                    number = image.frame_id - 1
                    if not (root / folder / image.name).is_file():
                        write_image(root / folder / image.name, rgb_image(number))
            for kind in ("binary", "text", "old text"):
                folder = root / "models" / f"{cameras} {lens} {kind}"
                folder.mkdir(parents=True)
                model.write_binary(folder) if kind == "binary" else model.write_text(folder)
                if kind == "old text":
                    for name in ("rigs", "frames"):
                        (folder / f"{name}.txt").unlink()
                models.append(folder)

    def fuzzer(rng: np.random.Generator) -> str:
        folder = models[rng.integers(0, len(models))]
        shutil.rmtree(root / "sparse", ignore_errors=True)
        shutil.copytree(folder, root / "sparse" / "0")
        files = sorted((root / "sparse" / "0").iterdir())
        path = files[rng.integers(0, len(files))]
        path.write_bytes(changed_bytes(path.read_bytes(), rng))
        capture = load_capture(root)
        assert np.isfinite(capture.points).all()
        assert np.isfinite(capture.scene_extent)
        return f"{folder.name}, {path.name}"

    return fuzzer


@pytest.mark.rotating("fuzzed input")
def test_changed_colmap_models():
    """Lengths, numbers, names and lines of every file."""
    run_apart(__file__, number_of_cases(300))


if __name__ == "__main__":
    main(make)
