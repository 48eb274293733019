"""The benchmark of boards: the command's calibration beside a rig's truth."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from benchmark_scripts import run_script
from seen_boards import true_rig


def test_circles_give_the_true_rig(tmp_path: Path) -> None:
    """Focal lengths to 0.2%, rotation to 0.05°, translation to 1 mm."""
    rig = true_rig()
    keys = ("fx", "cx", "cy", "k1", "k2")
    lenses = {
        name: {**asdict(lens), **dict(zip(keys, lens.params)), "fy": lens.params[0], "p1": 0, "p2": 0}
        for name, lens in (("visible", rig.rgb), ("thermal", rig.thermal))
    }
    truth = {**lenses, "thermal_to_visible": np.linalg.inv(rig.thermal_from_rgb).tolist()}
    (tmp_path / "truth.json").write_text(json.dumps(truth))
    options = ["--boards", "circles", "--seeds", "1", "--out", str(tmp_path / "out")]
    done = run_script("bench_boards.py", str(tmp_path / "truth.json"), *options)
    assert done.returncode == 0, done.stderr
    (row,) = json.loads((tmp_path / "out" / "boards.json").read_text())["rows"]
    assert 0 < row["rgb_focal"] < 0.002
    assert 0 < row["thermal_focal"] < 0.002
    assert 0 < row["degrees"] < 0.05
    assert 0 < row["millimetres"] < 1
    assert "| circles | 1 |" in done.stdout
