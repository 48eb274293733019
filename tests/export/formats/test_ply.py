"""PLY files against plyfile, an independent reader."""

from pathlib import Path

import numpy as np
import pytest
import torch

from splat_scenes import random_splats
from thermosplat.export.formats.ply import write_splats

plyfile = pytest.importorskip("plyfile", reason='plyfile is not installed (pip install ".[test]")')

INRIA_ORDER = (
    ["x", "y", "z", "nx", "ny", "nz"]
    + [f"f_dc_{i}" for i in range(3)]
    + [f"f_rest_{i}" for i in range(45)]
    + ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
)


def test_degree_4_is_written_where_it_is_used(tmp_path: Path) -> None:
    """24 coefficients of each channel, channel by channel; where degree 4 is zero, the layout that viewers expect."""
    splats = random_splats(7, 4)
    vertex = plyfile.PlyData.read(str(write_splats(tmp_path / "four.ply", splats).path))["vertex"]
    for channel in range(3):
        for base in range(24):
            np.testing.assert_array_equal(vertex[f"f_rest_{24 * channel + base}"], splats.shN[:, base, channel])
    splats.shN[:, 15:] = 0.0
    vertex = plyfile.PlyData.read(str(write_splats(tmp_path / "three.ply", splats).path))["vertex"]
    assert [prop.name for prop in vertex.properties] == INRIA_ORDER


@pytest.mark.parametrize("sh_degree", [0, 1, 3])
def test_layout_is_inrias(sh_degree: int, tmp_path: Path) -> None:
    """Names, order, type and meaning of the 62 properties; lower SH degrees are padded with zeros."""
    splats = random_splats(7, sh_degree)
    written = write_splats(tmp_path / "splat.ply", splats, ["thermosplat test", "range 10 °C"])
    assert (written.num_gaussians, written.num_dropped) == (7, 0)
    ply = plyfile.PlyData.read(str(written.path))
    assert not ply.text
    assert ply.byte_order == "<"
    assert ply.comments == ["thermosplat test", "range 10 ?C"]
    vertex = ply["vertex"]
    assert [prop.name for prop in vertex.properties] == INRIA_ORDER
    assert {prop.val_dtype for prop in vertex.properties} == {"f4"}

    def columns(*names: str) -> np.ndarray:
        return np.stack([vertex[name] for name in names], axis=1)

    np.testing.assert_array_equal(columns("x", "y", "z"), splats.means.numpy())
    np.testing.assert_array_equal(columns("nx", "ny", "nz"), 0)
    np.testing.assert_array_equal(columns("f_dc_0", "f_dc_1", "f_dc_2"), splats.sh0[:, 0].numpy())
    np.testing.assert_array_equal(vertex["opacity"], splats.logit_opacities.numpy())
    np.testing.assert_array_equal(columns("scale_0", "scale_1", "scale_2"), splats.log_scales.numpy())
    quats = splats.quats / splats.quats.norm(dim=1, keepdim=True)
    np.testing.assert_allclose(columns("rot_0", "rot_1", "rot_2", "rot_3"), quats.numpy(), atol=1e-6)
    bases = splats.shN.shape[1]
    for channel in range(3):
        names = [f"f_rest_{15 * channel + base}" for base in range(15)]
        expected = np.zeros((7, 15), np.float32)
        expected[:, :bases] = splats.shN[:, :, channel].numpy()
        np.testing.assert_array_equal(columns(*names), expected)


@pytest.mark.parametrize(("used", "count"), [(0, 0), (1, 3), (2, 8), (3, 15)])
def test_compact_files_have_the_degrees_in_use(used: int, count: int, tmp_path: Path) -> None:
    """As many f_rest as the highest degree of any Gaussian needs, channel by channel; the rest is the same."""
    splats = random_splats(7, 3)
    splats.shN[:, (used + 1) ** 2 - 1 :] = 0.0
    splats.shN[1:, 3:] = 0.0
    vertex = plyfile.PlyData.read(str(write_splats(tmp_path / "splat.ply", splats, compact=True).path))["vertex"]
    names = [prop.name for prop in vertex.properties]
    assert names == [n for n in INRIA_ORDER if not n.startswith("f_rest") or int(n.split("_")[2]) < 3 * count]
    for channel in range(3):
        for base in range(count):
            np.testing.assert_array_equal(vertex[f"f_rest_{count * channel + base}"], splats.shN[:, base, channel])
    np.testing.assert_array_equal(vertex["scale_2"], splats.log_scales[:, 2])


def test_broken_and_invisible_gaussians_are_dropped_and_counted(tmp_path: Path) -> None:
    """A NaN anywhere, or an opacity below 1/255, keeps a Gaussian out of the file; the others keep their order."""
    splats = random_splats(6, 1)
    splats.logit_opacities[:] = torch.logit(torch.tensor(0.5))
    splats.means[1, 2] = torch.nan
    splats.shN[2, 0, 0] = torch.inf
    splats.logit_opacities[4] = torch.logit(torch.tensor(0.9 / 255))
    splats.logit_opacities[5] = torch.logit(torch.tensor(1.1 / 255))
    written = write_splats(tmp_path / "splat.ply", splats)
    assert (written.num_gaussians, written.num_dropped) == (3, 3)
    vertex = plyfile.PlyData.read(str(written.path))["vertex"]
    np.testing.assert_array_equal(vertex["x"], splats.means[[0, 3, 5], 0].numpy())


def test_empty_scene(tmp_path: Path) -> None:
    """No Gaussians make a valid file with no vertices."""
    written = write_splats(tmp_path / "splat.ply", random_splats(0, 2))
    assert plyfile.PlyData.read(str(written.path))["vertex"].count == 0


def test_scalars_follow_the_properties(tmp_path: Path) -> None:
    """Further values, of the Gaussians that are written, stand behind what viewers of splats read."""
    splats = random_splats(7, 1)
    splats.logit_opacities[:] = 0.0
    splats.means[2] = torch.nan
    celsius = torch.arange(7.0) + 20.0
    written = write_splats(tmp_path / "splat.ply", splats, scalars={"scalar_thermal_celsius": celsius})
    vertex = plyfile.PlyData.read(str(written.path))["vertex"]
    assert [prop.name for prop in vertex.properties] == [*INRIA_ORDER, "scalar_thermal_celsius"]
    np.testing.assert_array_equal(vertex["scalar_thermal_celsius"], [20, 21, 23, 24, 25, 26])
