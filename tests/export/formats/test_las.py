"""Points as LAS: coordinates, colours, values and the coordinate system come back."""

from pathlib import Path

import numpy as np
import pytest

from thermosplat.errors import UserError
from thermosplat.export.formats.las import check_laspy, write_las


@pytest.mark.parametrize("epsg", [32632, None])
@pytest.mark.parametrize("count", [0, 500])
def test_points_come_back(tmp_path: Path, epsg: int | None, count: int) -> None:
    """UTM to half a millimetre, °C as they are; no coordinate system where there is none."""
    laspy = pytest.importorskip("laspy", reason='laspy is not installed (pip install ".[maps]")')
    pytest.importorskip("rasterio", reason='rasterio is not installed (pip install ".[maps]")')
    generator = np.random.default_rng(0)
    points = generator.uniform(-50, 50, (count, 3)) + np.array([447_319.0, 5_211_087.0, 452.0])
    colors = generator.integers(0, 256, (count, 3)).astype(np.uint8)
    celsius = generator.uniform(5, 40, count).astype(np.float32)
    write_las(tmp_path / "points.las", points, colors, {"scalar_thermal_celsius": celsius}, epsg)
    read = laspy.read(tmp_path / "points.las")
    np.testing.assert_allclose(np.asarray(read.xyz).reshape(-1, 3), points, atol=6e-4)
    np.testing.assert_array_equal(np.column_stack([read.red, read.green, read.blue]) >> 8, colors)
    np.testing.assert_array_equal(np.asarray(read["scalar_thermal_celsius"]), celsius)
    told = [vlr.string for vlr in read.header.vlrs if hasattr(vlr, "string")]
    assert len(told) == (epsg is not None)
    assert all("UTM zone 32N" in text for text in told)


def test_a_missing_laspy_is_explained(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the command that installs it."""
    monkeypatch.setitem(__import__("sys").modules, "laspy", None)
    with pytest.raises(UserError, match="not installed") as error:
        check_laspy()
    assert "[maps]" in (error.value.hint or "")
