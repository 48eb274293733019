"""thermosplat-eval, -render and -export on runs on the sample capture; every mistake ends with code 2."""

import json
import re
import shutil
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np
import pytest
from plyfile import PlyData

from sample_runs import QUICK, STEPS, Run
from thermosplat.cli import evaluate, export, render, train
from thermosplat.datasets import load_capture
from thermosplat.datasets.geo_file import GeoFrame
from thermosplat.export.maps.map_frame import MapFrame, local_frame
from thermosplat.novel_views.bookmarks import Bookmark, write_bookmarks


@pytest.mark.parametrize("main", [evaluate.main, render.main, export.main])
def test_mistakes_in_the_siblings(run: Run, main: Callable[[list[str]], int], finished: Path, tmp_path: Path) -> None:
    """No run, no such checkpoint, a damaged checkpoint: one message each, with the steps there are."""
    code, printed = run(main, tmp_path / "nothing")
    assert code == 2
    assert "No training run" in printed
    code, printed = run(main, finished, "--step", 77)
    assert code == 2
    assert f"no checkpoint of step 77. It has: --step {STEPS}." in printed
    (tmp_path / "broken" / "ckpts").mkdir(parents=True)
    (tmp_path / "broken" / "ckpts" / "step_000009.pt").write_bytes(b"half a checkpo")
    code, printed = run(main, tmp_path / "broken")
    assert code == 2
    assert "is damaged" in printed
    (tmp_path / "broken" / "ckpts" / "step_best.pt").write_bytes(b"a copy of the user's")
    code, printed = run(main, tmp_path / "broken", "--step", 77)
    assert code == 2
    assert "It has: --step 9." in printed


def test_eval_agrees_with_training(run: Run, finished: Path) -> None:
    """thermosplat-eval prints and writes the numbers that training ended with, and pictures of these frames alone."""
    stale = finished / "renders" / f"eval_{STEPS:06d}" / "desk_9999.png"
    stale.parent.mkdir(exist_ok=True)
    stale.write_bytes(b"x")
    code, printed = run(evaluate.main, finished, "--device", "cpu")
    assert code == 0
    assert not stale.exists()
    written = json.loads((finished / "stats" / f"eval_{STEPS:06d}.json").read_text())
    assert written["data"] == "sample"
    trained = json.loads((finished / "metrics.json").read_text())
    assert written["spectra"] == trained["spectra"] == ["rgb", "thermal"]
    for spectrum in ("rgb", "thermal"):
        assert written[spectrum]["psnr"] == pytest.approx(trained[spectrum]["psnr"], rel=1e-6)
        assert f"{trained[spectrum]['psnr']:.2f}" in printed
    assert "PSNR [dB]" in printed
    assert re.search(r"thermal .* [\d.]+ °C", printed)
    assert list((finished / "renders" / f"eval_{STEPS:06d}").glob("*.png"))


def test_regions_of_a_capture_with_ground_truth(run: Run, finished: Path, tmp_path: Path) -> None:
    """Training leaves regions.json, thermosplat-eval makes it again and prints it; other captures have no such file."""
    assert not (finished / "regions.json").exists()
    capture, folder = tmp_path / "with_truth", tmp_path / "run"
    shutil.copytree(str(files("thermosplat") / "sample"), capture)
    (capture / "ground_truth").mkdir()
    depth, label = np.full((150, 200), 2.0, np.float32), np.zeros((150, 200), np.uint8)
    label[:, 100:] = 1
    for image in (capture / "rgb").rglob("*.jpg"):
        np.savez(capture / "ground_truth" / image.stem, depth_rgb=depth, depth_thermal=depth, label=label)
    words = [capture, "--config", "demo", *QUICK]  # the preset of others than the sample sweeps depths
    assert run(train.main, *words, "--max-steps", 2, "--result-dir", folder)[0] == 0
    trained = json.loads((folder / "regions.json").read_text())
    assert trained["steps"] == 2
    assert list(trained["regions"]) == ["all", "glass", "unlabelled"]
    (folder / "regions.json").unlink()
    code, printed = run(evaluate.main, folder, "--device", "cpu")
    assert code == 0
    assert "glass" in printed
    again = json.loads((folder / "regions.json").read_text())
    for region, numbers in trained["regions"].items():
        for spectrum in ("rgb", "thermal"):
            known = {name: number for name, number in numbers[spectrum].items() if number is not None}
            found = {name: number for name, number in again["regions"][region][spectrum].items() if number is not None}
            assert found == pytest.approx(known, rel=1e-5)


def test_another_capture_is_noticed(run: Run, finished: Path, tmp_path: Path) -> None:
    """A run does not go on with a capture that lacks one of its training frames, and evaluating there says so."""
    other = tmp_path / "other"
    shutil.copytree(str(files("thermosplat") / "sample"), other)
    for folder in ("rgb", "thermal"):
        min((other / folder / "train").iterdir()).unlink()
    for folder in ("rgb", "thermal"):
        min((other / folder / "test").iterdir()).unlink()
    page = finished / "index.html"  # lists what the folder has
    before = {path: path.read_bytes() for path in finished.rglob("*") if path.is_file() and path != page}
    code, printed = run(train.main, other, "--resume", finished, "--max-steps", STEPS + 1)
    assert code == 2
    assert "cannot go on with another capture" in printed
    code, printed = run(evaluate.main, finished, "--data", other, "--device", "cpu")
    assert code == 0
    assert f"Is this the capture of {finished}?" in printed
    name = f"{STEPS:06d}_other"
    assert json.loads((finished / "stats" / f"eval_{name}.json").read_text())["data"] == str(other)
    assert list((finished / "renders" / f"eval_{name}").glob("*.png"))
    code, printed = run(render.main, finished, "--data", other, "--device", "cpu", "--frames", 2)
    assert code == 0
    assert f"Is this the capture of {finished}?" in printed
    assert (finished / "videos" / f"interp_rgb-thermal_{name}.mp4").is_file()
    assert {path: path.read_bytes() for path in before} == before  # its own results are as they were
    assert "Is this the capture" not in run(evaluate.main, finished, "--device", "cpu")[1]


def test_a_palette_file_that_is_gone(run: Run, tmp_path: Path) -> None:
    """The checkpoint holds the palette: the run is evaluated where its file is not, to the same numbers."""
    rows = [[level, level, 255 - level] for level in range(0, 256, 15)]
    palette, folder = tmp_path / "mine.json", tmp_path / "run"
    palette.write_text(json.dumps({"lut": rows}))
    words = ["--max-steps", 1, "--thermal.palette", palette, "--result-dir", folder]
    assert run(train.main, "sample", *QUICK, *words)[0] == 0
    palette.unlink()
    code, printed = run(evaluate.main, folder, "--device", "cpu")
    assert code == 0, printed
    trained, evaluated = (
        json.loads((folder / name).read_text()) for name in ("metrics.json", "stats/eval_000001.json")
    )
    assert evaluated["thermal"] == trained["thermal"]


def test_capture_with_other_held_out_frames_is_another(run: Run, finished: Path, tmp_path: Path) -> None:
    """Also where the training frames are the same: its numbers are not the run's."""
    other = tmp_path / "fewer"
    shutil.copytree(str(files("thermosplat") / "sample"), other)
    for folder in ("rgb", "thermal"):
        min((other / folder / "test").iterdir()).unlink()
    code, printed = run(evaluate.main, finished, "--data", other, "--device", "cpu")
    assert code == 0
    assert "other held-out frames" in printed
    assert (finished / "stats" / f"eval_{STEPS:06d}_fewer.csv").is_file()


@pytest.mark.parametrize("main", [evaluate.main, render.main])
def test_pictures_that_cannot_be_written(run: Run, main: Callable[[list[str]], int], finished: Path, tmp_path) -> None:
    """What keeps pictures from being written, here a file in the place of their folder, is said with the path."""
    shutil.copytree(finished / "ckpts", tmp_path / "ckpts")
    words = ["--path", "test", "--format", "png", "--modality", "rgb"] if main is render.main else []
    folder = "videos/test_rgb" if main is render.main else "renders/eval"
    (tmp_path / folder).parent.mkdir()
    (tmp_path / f"{folder}_{STEPS:06d}").write_text("")
    code, printed = run(main, tmp_path, "--device", "cpu", *words)
    assert code == 2
    assert "Could not write" in printed or "Could not make the folder" in printed
    assert "File exists" in printed


@pytest.mark.parametrize("words", [["--frames", "0"], ["--fps", "0"], ["--path", "zigzag"], ["--spectra", "sound"]])
def test_mistakes_in_render(run: Run, finished: Path, words: list[str]) -> None:
    """Impossible values of thermosplat-render's flags are refused by name."""
    code, printed = run(render.main, finished, *words)
    assert code == 2
    assert words[0] in printed


def test_render_along_a_path(run: Run, finished: Path) -> None:
    """All spectra side by side as a video, one alone as PNGs; --modality is another name of --spectra."""
    assert run(render.main, finished, "--frames", 3, "--device", "cpu")[0] == 0
    video = cv2.VideoCapture(str(finished / "videos" / f"interp_rgb-thermal_{STEPS:06d}.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 3
    code, printed = run(
        render.main, finished, "--path", "ellipse", "--frames", 2, "--spectra", "rgb", "--format", "png"
    )
    assert code == 0
    folder = finished / "videos" / f"ellipse_rgb_{STEPS:06d}"
    assert str(folder) in printed
    images = [cv2.imread(str(path)) for path in sorted(folder.iterdir())]
    assert len(images) == 2
    assert images[0].shape[1] * 2 == pytest.approx(video.get(cv2.CAP_PROP_FRAME_WIDTH), abs=1)
    assert not np.array_equal(images[0], images[1])
    assert run(render.main, finished, "--path", "test", "--modality", "rgb", "--format", "png")[0] == 0
    named = {path.name for path in (finished / "videos" / f"test_rgb_{STEPS:06d}").iterdir()}
    assert named == {path.name for path in (finished / "renders").glob("*.png")}


def test_export_elsewhere(run: Run, finished: Path, tmp_path: Path) -> None:
    """thermosplat-export writes the asked-for spectrum into the asked-for folder, the same as training did."""
    unfitted = ["--fit-passes", 0]
    code, printed = run(export.main, finished, "--spectra", "thermal", "--output", tmp_path / "out", *unfitted)
    assert code == 0
    assert "Gaussians" in printed
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["splat_thermal.ply"]
    original = finished / "ply" / "splat_thermal.ply"
    assert (tmp_path / "out" / "splat_thermal.ply").read_bytes() == original.read_bytes()
    assert (
        run(export.main, finished, "--modality", "thermal", "--output", tmp_path / "small", "--compact", *unfitted)[0]
        == 0
    )
    small = tmp_path / "small" / "splat_thermal.ply"
    assert small.stat().st_size < 0.35 * original.stat().st_size  # 17 of 62 properties


def test_temperatures_recalculated_by_every_command(run: Run, finished: Path, tmp_path: Path) -> None:
    """Results have names of their own and say that they are recalculated; what a run measured stays as it was."""
    asked = ["--emissivity", 0.7, "--reflected", 15]
    kept = (finished / "regions.json").read_bytes() if (finished / "regions.json").exists() else None
    code, printed = run(evaluate.main, finished, "--device", "cpu", *asked)
    assert code == 0
    assert "recalculated: emissivity 0.7, reflected 15 °C" in printed
    assert "Nobody says what this capture's temperatures were computed with" in printed
    numbers = json.loads((finished / "stats" / f"eval_{STEPS:06d}_recalculated.json").read_text())
    usual = json.loads((finished / "metrics.json").read_text())
    assert numbers["thermal"]["mae_celsius"] > 1.1 * usual["thermal"]["mae_celsius"]
    assert numbers["thermal"]["psnr"] == pytest.approx(usual["thermal"]["psnr"], abs=1e-3)
    assert kept == ((finished / "regions.json").read_bytes() if kept is not None else None)
    code, printed = run(render.main, finished, "--path", "test", "--format", "png", "--spectra", "thermal", *asked)
    assert code == 0
    assert (finished / "videos" / f"test_thermal_{STEPS:06d}_recalculated").is_dir()
    points = ["--format", "points", "--points", 50, "--spectra", "thermal", "--output", tmp_path]
    assert run(export.main, finished, *points, *asked)[0] == 0
    assert b"scalar_thermal_recalculated" in (tmp_path / "points_thermal.ply").read_bytes()[:2000]


@pytest.mark.parametrize(
    ("main", "words", "message"),
    [
        (evaluate.main, ["--emissivity", 0.3], "no temperature is recalculated"),
        (render.main, ["--humidity", 50], "--humidity must be 0 to 1"),
        (export.main, ["--air", 5], "these files have colours alone"),
        (evaluate.main, ["--labels", "nowhere.yaml"], "nowhere.yaml cannot be read"),
    ],
)
def test_what_cannot_be_recalculated(run: Run, finished: Path, main: object, words: list[object], message: str) -> None:
    """One sentence says why, and nothing is rendered."""
    code, printed = run(main, finished, *words)
    assert code == 2
    assert message in printed


def test_export_fits_colors(run: Run, finished: Path, tmp_path: Path) -> None:
    """The fit is on unless it is switched off; both distances from the exact render are printed, the fit's no worse."""
    code, printed = run(export.main, finished, "--spectra", "thermal", "--output", tmp_path, "--fit-passes", 1)
    assert code == 0
    before, after = (float(re.search(rf"([\d.]+) dB {word}", printed)[1]) for word in ("before the fit", "from the"))
    assert after >= before > 10
    assert (tmp_path / "splat_thermal.ply").is_file()


def test_export_of_other_formats(run: Run, finished: Path) -> None:
    """They lie in exports/; values are a setting of PLY."""
    code, _ = run(export.main, finished, "--format", "spz", "--fit-passes", 0)
    assert code == 0
    assert {path.name for path in (finished / "exports").iterdir()} == {"splat_rgb.spz", "splat_thermal.spz"}
    code, printed = run(export.main, finished, "--format", "glb", "--values")
    assert code == 2
    assert "--values is a setting of PLY, not of glb." in printed
    code, printed = run(export.main, finished, "--fit-passes", -1)
    assert code == 2
    assert "--fit-passes must be at least 0, found -1." in printed


def test_export_of_values(run: Run, finished: Path, tmp_path: Path) -> None:
    """Every file has the temperatures that CloudCompare shows, within the range of the palette."""
    plyfile = pytest.importorskip("plyfile", reason='plyfile is not installed (pip install ".[test]")')
    assert run(export.main, finished, "--values", "--fit-passes", 0, "--output", tmp_path)[0] == 0
    for name in ("rgb", "thermal"):
        vertex = plyfile.PlyData.read(str(tmp_path / f"splat_{name}.ply"))["vertex"]
        celsius = vertex["scalar_thermal_celsius"]
        assert -50 < celsius.min() <= celsius.max() < 200
        assert celsius.std() > 0


def test_export_of_maps(run: Run, finished: Path, tmp_path: Path) -> None:
    """Both spectra on one grid, in local coordinates; flags of maps are refused elsewhere."""
    rasterio = pytest.importorskip("rasterio", reason='rasterio is not installed (pip install ".[maps]")')
    words = ["--format", "orthomosaic", "--gsd", 0.05, "--extent", -1, -1, 1, 0.5, "--output", tmp_path]
    code, printed = run(export.main, finished, *words)
    assert code == 0
    assert "The map is in local coordinates" in printed
    for name, bands in (("rgb", 3), ("thermal", 1)):
        with rasterio.open(tmp_path / f"orthomosaic_{name}.tif") as file:
            assert (file.count, file.height, file.width) == (bands, 30, 40)
            assert file.bounds == (-1, -1, 1, 0.5)
            assert file.crs is None
    code, printed = run(export.main, finished, "--gsd", 0.05)
    assert code == 2
    assert "--gsd is a setting of maps, not of ply." in printed


def test_maps_of_a_capture_with_gps(run: Run, finished: Path, tmp_path: Path) -> None:
    """The GeoTIFF has the zone of the GPS positions and metres in it, and the picture of the map in local units."""
    rasterio = pytest.importorskip("rasterio", reason='rasterio is not installed (pip install ".[maps]")')
    warp = pytest.importorskip("rasterio.warp")
    capture, metres, middle = load_capture("sample"), 3.0, np.array([518_000.0, 5_260_000.0, 400.0])
    moved = tmp_path / "capture"
    shutil.copytree(capture.root, moved)
    local = local_frame(capture, "rgb")
    flown = MapFrame(local.rotation, metres, middle)  # a unit of the scene is 3 m
    rows = ["spectrum,file,source,width,height,time,latitude,longitude,altitude"]
    for frame in (*capture.train, *capture.test):
        view = frame.views["rgb"]
        east, north, up = flown.to_map(np.linalg.inv(view.viewmat)[:3, 3])
        (longitude,), (latitude,) = warp.transform("EPSG:32632", "EPSG:4326", [east], [north])
        rows.append(f"rgb,{view.path.name},x.jpg,200,150,,{latitude:.10f},{longitude:.10f},{up:.4f}")
    (moved / "frames.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")

    def map_of(folder: str, *words: object) -> tuple[np.ndarray, str]:
        words = ("--format", "orthomosaic", "--spectra", "rgb", "--output", tmp_path / folder, *words)
        code, printed = run(export.main, finished, *words)
        assert code == 0
        with rasterio.open(tmp_path / folder / "orthomosaic_rgb.tif") as file:
            found.append(file.profile | {"bounds": file.bounds})
            return file.read(1), printed

    found: list[dict] = []
    west, south = middle[:2] - metres
    expected, _ = map_of("local", "--gsd", 0.05, "--extent", -1, -1, 1, 1)
    seen, printed = map_of("flown", "--gsd", 0.15, "--extent", west, south, west + 6, south + 6, "--data", moved)
    assert "The map is georeferenced." in printed
    assert found[0]["crs"] is None
    assert found[1]["crs"].to_epsg() == 32632
    assert found[1]["crs"].linear_units == "metre"
    np.testing.assert_allclose(found[1]["bounds"], (west, south, west + 6, south + 6), atol=1e-6)
    there = np.isfinite(expected) & np.isfinite(seen)
    assert there.sum() > 20  # a scene of a few steps covers little
    assert np.isfinite(expected).sum() - there.sum() < 5
    assert expected[there].std() > 0.05
    np.testing.assert_allclose(seen[there], expected[there], atol=0.01)


def test_exports_of_a_flight_lie_in_one_utm_frame(run: Run, finished: Path, tmp_path: Path) -> None:
    """Without a flag: splats, points and LAS at one place, the map with its zone around them, geo.json beside them."""
    rasterio = pytest.importorskip("rasterio", reason='rasterio is not installed (pip install ".[maps]")')
    laspy = pytest.importorskip("laspy", reason='laspy is not installed (pip install ".[maps]")')
    flight, geo = tmp_path / "flight", GeoFrame(47.0512, 8.3064, 452.0, 0.8, 40)
    shutil.copytree(finished, flight)
    (flight / "geo.json").write_text(json.dumps(geo.content()))
    for words in (("orthomosaic", "--gsd", 0.05), ("points", "--points", 2000), ("las", "--points", 2000)):
        code, printed = run(export.main, flight, "--spectra", "thermal", "--format", *words)
        assert code == 0, printed
    code, printed = run(export.main, flight, "--spectra", "thermal", "--fit-passes", 0)
    assert "UTM zone 32N from 447319.0 5211087.0 452.0" in printed
    origin = json.loads((flight / "ply" / "geo.json").read_text())["origin"]
    assert json.loads((flight / "exports" / "geo.json").read_text())["origin"] == origin
    las = np.asarray(laspy.read(flight / "exports" / "points_thermal.las").xyz)
    points = PlyData.read(flight / "exports" / "points_thermal.ply")["vertex"]
    np.testing.assert_allclose(np.column_stack([points[axis] for axis in "xyz"]) + origin, las, atol=2e-3)
    splats = PlyData.read(flight / "ply" / "splat_thermal.ply")["vertex"]
    middle = np.median(np.column_stack([splats[axis] for axis in "xyz"]) + origin, axis=0)
    assert np.linalg.norm(middle - np.median(las, axis=0)) < 3.0
    with rasterio.open(flight / "exports" / "orthomosaic_thermal.tif") as file:
        assert (file.crs.to_epsg(), file.dtypes, file.units) == (32632, ("float32",), ("celsius",))
        assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert file.bounds.left < middle[0] < file.bounds.right
        assert file.bounds.bottom < middle[1] < file.bounds.top


def test_thermal_images_lie_beside_pictures(run: Run, finished: Path) -> None:
    """Of a spectrum with a unit, as 32-bit floats in °C; those of a longer path are gone, a user's file stays."""
    folder = finished / "videos" / f"interp_rgb-thermal_{STEPS:06d}"
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("00007_thermal.tiff", "mine.tiff"):
        (folder / name).write_bytes(b"x")
    code, _ = run(render.main, finished, "--format", "png", "--frames", 2)
    assert code == 0
    assert sorted(path.name for path in folder.glob("*.tiff")) == [
        "00000_thermal.tiff",
        "00001_thermal.tiff",
        "mine.tiff",
    ]
    values = cv2.imread(str(folder / "00001_thermal.tiff"), cv2.IMREAD_UNCHANGED)
    assert values.dtype == np.float32
    assert 0 < np.nanmin(values) <= np.nanmax(values) < 100
    (folder / "mine.tiff").unlink()


def test_render_layouts_and_bookmarks(run: Run, finished: Path, tmp_path: Path) -> None:
    """A path through the viewer's bookmarks, as a wipe with colour bar and title."""
    write_bookmarks(tmp_path / "marks.json", [Bookmark(n, _before_desk(x), 40.0) for n, x in (("a", 0.0), ("b", 0.4))])
    words = ["--path", tmp_path / "marks.json", "--format", "png", "--frames", 3]
    code, printed = run(render.main, finished, *words, "--layout", "wipe", "--color-bar", "--title", "Desk 20 °C")
    assert code == 0
    folder = finished / "videos" / f"bookmarks-wipe_rgb-thermal_{STEPS:06d}"
    assert str(folder) in printed
    first, middle, last = (cv2.imread(str(folder / f"{index:05d}.png")) for index in range(3))
    assert first.shape[1] > 50 + 20  # data-factor 4: 50 px, and the bar
    assert not np.array_equal(first, last)
    assert not np.array_equal(first, middle)
    code, printed = run(render.main, finished, "--path", "elipse")
    assert code == 2
    assert "--path elipse is neither a path nor a file." in printed
    code, printed = run(render.main, finished, "--title", "Wärme")
    assert code == 2
    assert "letters that pictures cannot show" in printed


def test_render_says_what_browsers_play(run: Run, finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the extra one line says what to install; with it nothing is said."""
    words = ["--path", "ellipse", "--frames", 2]
    assert ".[video]" not in run(render.main, finished, *words)[1]
    monkeypatch.setattr("thermosplat.pictures.video.browsers_play_videos", lambda: False)
    code, printed = run(render.main, finished, *words)
    assert code == 0
    assert 'For H.264: pip install ".[video]"' in printed


def _before_desk(x: float) -> np.ndarray:
    viewmat = np.eye(4)
    viewmat[:3, 3] = [x, 0.0, 2.0]
    return viewmat
