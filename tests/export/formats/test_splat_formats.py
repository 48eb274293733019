"""Every format of splats, read back by a reader that others wrote."""

import json
import math
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from scenes.splat_files import READERS
from splat_scenes import random_splats, scene_like_splats
from thermosplat.datasets.placement import Placement
from thermosplat.errors import UserError
from thermosplat.export.formats.splat_formats import HELD_DEGREES, SPLAT_FORMATS, Described, SplatFormat, write_format
from thermosplat.export.splats import SplatArrays, Splats, drawable, in_world

EXACT = {"means": 1e-6, "angle": 2e-3, "log_scales": 1e-5, "opacities": 1e-5, "sh0": 1e-6, "shN": 1e-6}
TOLERANCES: dict[SplatFormat, dict[str, float]] = {
    "ply": EXACT,
    "glb": EXACT,
    "usd": EXACT,
    # half a step of each: 10 bits of a chunk's span, 10-bit quaternions, bytes
    "compressed-ply": {
        "means": 0.02,
        "angle": 5e-3,
        "log_scales": 5e-3,
        "opacities": 2.1e-3,
        "sh0": 0.03,
        "shN": 0.016,
    },
    # 2^-18 units, 9-bit quaternions, 1/32 of a log, bytes of 1/38.25 and 1/128
    "spz": {"means": 1e-5, "angle": 6e-3, "log_scales": 0.0313, "opacities": 2.1e-3, "sh0": 0.0132, "shN": 0.004},
    # 16 bits of a logarithm, 8-bit quaternions, codebooks; harmonics are shared by several Gaussians (see below)
    "sog": {"means": 1e-3, "angle": 0.02, "log_scales": 0.15, "opacities": 2.1e-3, "sh0": 0.15, "shN": math.inf},
}


def read_back(format: SplatFormat, path: Path) -> Splats:
    package, read = READERS[format]
    pytest.importorskip(package, reason=f'{package} is not installed (pip install ".[test]")')
    return read(path)


def matched(original: SplatArrays, found: Splats) -> tuple[SplatArrays, SplatArrays]:
    """Both in one order, as formats sort Gaussians; opacities and positions tell which is which."""
    return original, drawable(found)[_nearest(original.means, found.means.numpy())]


def _nearest(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    squared = ((points[:, None].astype(np.float64) - others[None]) ** 2).sum(axis=-1)
    nearest = squared.argmin(axis=1)
    assert len(np.unique(nearest)) == len(points)
    return nearest


@pytest.mark.parametrize("sh_degree", [0, 2])
@pytest.mark.parametrize("format", SPLAT_FORMATS)
def test_another_reader_finds_the_same_gaussians(format: SplatFormat, sh_degree: int, tmp_path: Path) -> None:
    """Positions, rotations, sizes, opacities and colours come back, in the frame of the poses, to half a step."""
    original = drawable(scene_like_splats(700, sh_degree))
    splats = Splats(*(torch.from_numpy(getattr(original, name)) for name in original.__dataclass_fields__))
    splats = Splats(*(*list(vars(splats).values())[:4], splats.sh0[:, None], splats.shN))
    written = write_format(format, tmp_path, Described(splats, "rgb"))
    assert (written.num_gaussians, written.num_dropped) == (700, 0)
    expected, found = matched(original, read_back(format, written.path))
    limits = TOLERANCES[format]
    cosines = np.abs((expected.quats * found.quats).sum(axis=1)).clip(max=1.0)
    assert (2 * np.arccos(cosines)).max() < limits["angle"]
    for name in ("means", "log_scales", "opacities", "sh0"):
        assert np.abs(getattr(found, name) - getattr(expected, name)).max() < limits[name], name
    assert found.sh_degree == sh_degree
    if sh_degree:
        error = np.abs(found.shN - expected.shN)
        assert error.max() < limits["shN"]
        assert error.mean() < 0.2 * np.abs(expected.shN).mean()


@pytest.mark.parametrize("format", SPLAT_FORMATS)
def test_broken_and_invisible_gaussians_stay_out(format: SplatFormat, tmp_path: Path) -> None:
    """A value that is not finite, or an opacity below 1/255, keeps a Gaussian out of any file; both are counted."""
    splats = scene_like_splats(20, 1)
    splats.logit_opacities[:] = 0.0
    splats.means[3, 1] = torch.inf
    splats.shN[5, 0, 0] = torch.nan
    splats.logit_opacities[7] = -8.0
    written = write_format(format, tmp_path, Described(splats, "thermal"))
    assert (written.num_gaussians, written.num_dropped) == (17, 3)
    assert len(read_back(format, written.path).means) == 17


@pytest.mark.parametrize("format", ["compressed-ply", "spz", "glb", "usd"])
def test_an_empty_scene_is_a_file_without_gaussians(format: SplatFormat, tmp_path: Path) -> None:
    """No Gaussians are no error where the format can say so."""
    written = write_format(format, tmp_path, Described(random_splats(0, 1), "rgb"))
    assert written.num_gaussians == 0
    assert written.path.stat().st_size > 0


def test_sog_holds_no_empty_scene(tmp_path: Path) -> None:
    """The format has no image of no pixels; that is said."""
    with pytest.raises(UserError, match="SOG holds no empty scene"):
        write_format("sog", tmp_path, Described(random_splats(0, 1), "rgb"))


@pytest.mark.parametrize(("unit", "said"), [(1e-5, "half of this scene's are smaller"), (1e7, "are larger")])
def test_spz_refuses_gaussians_beyond_its_sizes(unit: float, said: str, tmp_path: Path) -> None:
    """Bytes of log-scales end at 4.5e-5 and 380 units: a scene in other units would be blown up or shrunk."""
    splats = in_world(random_splats(40, 1), Placement(unit=unit))
    with pytest.raises(UserError, match=said):
        write_format("spz", tmp_path, Described(replace(splats, means=0 * splats.means), "rgb"))


def test_spz_refuses_positions_beyond_its_fixed_point(tmp_path: Path) -> None:
    """24 bits end at 8 million units."""
    splats = scene_like_splats(3, 0)
    splats.means[0] = 2e7
    with pytest.raises(UserError, match="SPZ holds positions up to"):
        write_format("spz", tmp_path, Described(splats, "rgb"))


def test_the_same_scene_gives_the_same_bytes(tmp_path: Path) -> None:
    """No time of day and no random start is in a file."""
    for format in ("compressed-ply", "spz", "sog", "glb"):
        first, second = (
            write_format(format, tmp_path / name, Described(scene_like_splats(300, 1), "rgb")).path.read_bytes()
            for name in ("a", "b")
        )
        assert first == second, format


def test_sog_says_what_it_is(tmp_path: Path) -> None:
    """Version, count and files of meta.json are those of the archive."""
    written = write_format("sog", tmp_path, Described(scene_like_splats(300, 1), "rgb"))
    with zipfile.ZipFile(written.path) as archive:
        meta = json.loads(archive.read("meta.json"))
        named = {name for part in meta.values() if isinstance(part, dict) for name in part.get("files", [])}
        assert named == set(archive.namelist()) - {"meta.json"}
    assert (meta["version"], meta["count"], meta["antialias"]) == (2, 300, False)
    assert meta["shN"]["bands"] == 1


def test_usd_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without usd-core one sentence names the extra."""
    monkeypatch.setitem(__import__("sys").modules, "pxr", None)
    with pytest.raises(UserError, match=r'pip install "\.\[usd\]"'):
        write_format("usd", tmp_path, Described(scene_like_splats(3, 0), "rgb"))


@pytest.mark.parametrize("format", sorted(set(HELD_DEGREES) & set(SPLAT_FORMATS)))
def test_a_format_without_room_for_a_degree_says_so(format: SplatFormat, tmp_path: Path) -> None:
    """Nothing is left out of a file in silence; where degree 4 is zero everywhere, there is nothing to leave out."""
    splats = random_splats(5, 4)
    with pytest.raises(UserError, match=f"{format} holds spherical harmonics up to degree 3.*rgb use 4") as raised:
        write_format(format, tmp_path, Described(splats, "rgb"))
    assert "--format ply" in str(raised.value)
    assert not list(tmp_path.iterdir())
    splats.shN[:, 15:] = 0.0
    assert write_format(format, tmp_path, Described(splats, "rgb")).num_gaussians == 5
