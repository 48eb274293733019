"""The benchmark scripts run, on a scene far too small to measure anything."""

import json
import os
import subprocess
import sys
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]


def test_rasterization_benchmark_runs(tmp_path: Path) -> None:
    """Both CPU cases are checked, timed stage by stage and written to the JSON file."""
    report = tmp_path / "report.json"
    script = REPOSITORY / "benchmarks" / "bench_rasterization.py"
    options = ["--device", "cpu", "--count", "200", "--sizes", "32x24", "--repeats", "1", "--no-peers"]
    paths = [str(REPOSITORY / "src"), str(REPOSITORY), os.environ.get("PYTHONPATH", "")]
    done = subprocess.run(
        [sys.executable, str(script), *options, "--json", str(report)],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    written = json.loads(report.read_text())
    assert [row["case"] for row in written["rows"]] == ["features", "rgbt"]
    for row in written["rows"]:
        assert row["forward"]["thermosplat"]["median_ms"] > 0
        assert row["error_to_float64"]["thermosplat"]["image_mean"] < 1e-6
        assert set(row["stages"]) == {
            "projection",
            "binning",
            "blending",
            "blending adjoint",
            "projection adjoint",
        }
    assert written["environment"]["renderers"]["thermosplat"]
    assert "thermosplat" in done.stdout
