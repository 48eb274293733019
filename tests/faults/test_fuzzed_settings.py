"""Changed transforms files, statements, palettes and YAML: a result, or one sentence."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from capture_folders import write_transforms
from fuzzing import Fuzzer, changed_bytes, main, number_of_cases, run_apart
from thermosplat.config import TrainConfig
from thermosplat.config.files import load_config, to_dict, to_yaml
from thermosplat.datasets import load_capture
from thermosplat.thermal.radiometry import FLIR_IRON

HOSTILE: list[Any] = [
    *(None, True, "", "x", "x" * 5000, "../..", "/", "/dev/zero", "images", "\0", "a/" * 3000, "${oc.env:HOME}"),
    *(0, -1, -5, 2**31, 2**63, 2**64, 10**400, 0.5, 1e30, -1e30, 1e300, 1e308, 1e-300),
    *(float("nan"), float("inf"), [], {}, [[]], [1, 2, 3], {"a": 1}, [[0.0] * 4] * 4, ["x"] * 1000),
]


def replaced(value: Any, rng: np.random.Generator) -> Any:
    """The same tree with something else in one place, or without it."""
    if isinstance(value, dict | list) and value and rng.integers(0, 6):
        keys = list(value) if isinstance(value, dict) else list(range(len(value)))
        key = keys[rng.integers(0, len(keys))]
        copied = value.copy()
        if rng.integers(0, 8) == 0:
            del copied[key]
        else:
            copied[key] = replaced(value[key], rng)
        return copied
    hostile = HOSTILE[rng.integers(0, len(HOSTILE))]
    if rng.integers(0, 30) == 0:
        for _ in range(int(rng.choice([5, 40, 900]))):
            hostile = [hostile]
    return hostile


def make(root: Path) -> Fuzzer:
    """A ThermoScenes capture with every file of settings that may lie in it, and a configuration."""
    names = [f"images/frame_{'eval' if n % 4 == 0 else 'train'}_{n:05d}.png" for n in range(4)]
    lists = {"train_filenames": names[1:], "test_filenames": names[:1]}
    write_transforms(root, 4, k1=0.01, **lists, applied_transform=np.eye(4)[:3].tolist(), ply_file_path="cloud.ply")
    header = b"ply\nformat ascii 1.0\nelement vertex 5\n"
    header += b"".join(b"property float %c\n" % axis for axis in b"xyz")
    header += b"property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
    (root / "cloud.ply").write_bytes(header + b"".join(b"%d 1 2 3 4 5\n" % n for n in range(5)))
    (root / "ironbow_lut.json").write_text(json.dumps({"lut": np.round(255 * FLIR_IRON.colors[::8]).tolist()}))
    (root / "thermal" / "units.json").write_text(
        json.dumps({"unit": "celsius", "palette_min_C": 1, "palette_max_C": 9})
    )
    (root / "mine.yaml").write_text(to_yaml(TrainConfig()))
    files = [root / name for name in ("transforms_thermal.json", "temperature_bounds.json", "ironbow_lut.json")]
    files += [root / "thermal" / "units.json", root / "cloud.ply", root / "mine.yaml"]
    originals = {path: path.read_bytes() for path in files}
    likely = np.array([6, 1, 1, 1, 2, 4]) / 15
    settings = json.loads(json.dumps(to_dict(TrainConfig())))

    def fuzzer(rng: np.random.Generator) -> str:
        path = files[rng.choice(len(files), p=likely)]
        original = originals[path]
        if path.suffix == ".ply" or rng.integers(0, 2):
            content = changed_bytes(original, rng)
        else:
            tree = settings if path.suffix == ".yaml" else json.loads(original)
            content = json.dumps(replaced(tree, rng)).encode()  # YAML reads JSON
        path.write_bytes(content)
        try:
            if path.suffix == ".yaml":
                load_config(path)
            else:
                capture = load_capture(root)
                assert np.isfinite(capture.points).all()
                assert np.isfinite(capture.scene_extent)
        finally:
            path.write_bytes(original)
        return path.name

    return fuzzer


@pytest.mark.rotating("fuzzed input")
def test_changed_settings():
    """Bytes of the files, and values of their trees."""
    run_apart(__file__, number_of_cases(600))


if __name__ == "__main__":
    main(make)
