"""Calibrated cameras become pinhole cameras."""

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
import torch

from capture_folders import synthetic_model, write_image, write_model, write_rgbt_scenes, write_transforms
from thermosplat.datasets import load_capture
from thermosplat.datasets.frame_tensors import ViewTensors, lens_tensor
from thermosplat.datasets.lens import RENDERED, Lens, camera_through_lens, rectification, rectified_camera, shrunk
from thermosplat.errors import UserError
from thermosplat.scene.lens_slopes import bent

LENSES = {
    "SIMPLE_RADIAL": (60.0, 32.0, 24.0, -0.1),
    "RADIAL": (60.0, 32.0, 24.0, -0.2, 0.05),
    "OPENCV": (60.0, 62.0, 31.0, 25.0, 0.05, -0.01, 0.002, -0.003),
    "FULL_OPENCV": (60.0, 62.0, 31.0, 25.0, 0.3, 0.1, 0.002, -0.003, 0.01, 0.4, 0.1, 0.02),
    "SIMPLE_FISHEYE": (60.0, 32.0, 24.0),
    "FISHEYE": (60.0, 61.0, 32.0, 24.0),
    "SIMPLE_RADIAL_FISHEYE": (60.0, 32.0, 24.0, -0.05),
    "RADIAL_FISHEYE": (60.0, 32.0, 24.0, -0.05, 0.02),
    "OPENCV_FISHEYE": (60.0, 61.0, 32.0, 24.0, 0.03, -0.02, 0.01, -0.002),
}
"""Those that are rendered through."""
RESAMPLED = {
    "FOV": (60.0, 62.0, 31.0, 25.0, 0.6),
    "THIN_PRISM_FISHEYE": (60.0, 61.0, 32.0, 24.0, 0.03, -0.02, 0.002, -0.003, 0.01, -0.002, 0.003, -0.001),
    "RAD_TAN_THIN_PRISM_FISHEYE": (60.0, 61.0, 32.0, 24.0, 0.03, -0.02, *([0.001] * 10)),
    "SIMPLE_DIVISION": (60.0, 32.0, 24.0, -0.1),
    "DIVISION": (60.0, 61.0, 32.0, 24.0, -0.1),
    "EUCM": (60.0, 61.0, 32.0, 24.0, 0.5, 1.1),
}
"""Those that images are resampled from, and no more."""
PINHOLES, PANORAMAS = {"SIMPLE_PINHOLE", "PINHOLE"}, {"EQUIRECTANGULAR"}


def test_pinhole_models_are_used_as_they_are():
    """PINHOLE and SIMPLE_PINHOLE need no resampling, and their intrinsics are kept."""
    for lens in (Lens("PINHOLE", (40.0, 41.0, 15.0, 12.0), 32, 24), Lens("SIMPLE_PINHOLE", (40.0, 15.0, 12.0), 32, 24)):
        got = rectification(lens, 32, 24)
        assert got.maps is None
        assert (got.camera.fx, got.camera.cx, got.camera.cy) == (40.0, 15.0, 12.0)
        image = np.zeros((24, 32, 3), np.uint8)
        assert got.apply(image) is image


def test_focal_lengths_of_each_kind_of_camera():
    """One where both axes share it, two elsewhere; principal points and distortion are none."""
    assert Lens("SIMPLE_RADIAL", (40.0, 15.0, 12.0, 0.1), 32, 24).focal_lengths() == (40.0,)
    for model, rest in (("PINHOLE", ()), ("OPENCV", (0.1, 0.0, 0.0, 0.0)), ("OPENCV_FISHEYE", (0.1, 0.0, 0.0, 0.0))):
        assert Lens(model, (40.0, 41.0, 15.0, 12.0, *rest), 32, 24).focal_lengths() == (40.0, 41.0)


def test_scaled_file_scales_the_intrinsics():
    """A file of half the calibrated size has half the focal length."""
    camera = rectification(Lens("PINHOLE", (40.0, 44.0, 16.0, 12.0), 32, 24), 16, 12).camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height) == (20, 22, 8, 6, 16, 12)


@pytest.mark.parametrize(
    ("width", "height", "fits"),
    [(640, 480, True), (320, 240, True), (633, 476, True), (954, 718, True), (480, 640, False), (640, 512, False)],
)
def test_images_of_nearly_the_same_aspect_fit_a_camera(width: int, height: int, fits: bool):
    """The sizes that occur in RGBT-Scenes fit a 640x480 camera; a turned or cropped image does not."""
    assert Lens("PINHOLE", (500.0, 500.0, 320.0, 240.0), 640, 480).fits(width, height) is fits


@pytest.mark.parametrize(("model", "params"), (LENSES | RESAMPLED).items())
@pytest.mark.parametrize("scale", [1, 2])
def test_undistortion_shows_each_point_where_the_pinhole_camera_projects_it(model, params, scale):
    """A smooth pattern painted on the distorted image by direction reads the same at the pinhole projection."""
    lens = Lens(model, params, 64, 48)
    source = pycolmap.Camera(model=model, params=list(params), width=64, height=48)
    width, height = 64 * scale, 48 * scale

    def pattern(rays: np.ndarray) -> np.ndarray:
        return np.sin(3 * rays[..., 0] / rays[..., 2]) + np.cos(2 * rays[..., 1] / rays[..., 2])

    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    pixels = np.stack([x, y], -1).reshape(-1, 2) / scale
    flat = np.asarray(source.cam_from_img(pixels))
    distorted = pattern(np.concatenate([flat[:, :2], np.ones((len(flat), 1))], 1)).reshape(height, width)
    got = rectification(lens, width, height)
    camera = got.camera
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
    seen = got.apply(distorted.astype(np.float32))
    assert seen.shape == (camera.height, camera.width)
    inside = (slice(1, -1), slice(1, -1))
    np.testing.assert_allclose(seen[inside], pattern(rays)[inside], atol=0.01)


def test_shrunk_rounds_sizes_and_keeps_the_true_ratio():
    """Sides are rounded, and the intrinsics follow the rounded size."""
    camera = rectification(Lens("PINHOLE", (40.0, 40.0, 16.5, 12.0), 33, 25), 33, 25).camera
    small = shrunk(camera, 4)
    assert (small.width, small.height) == (8, 6)
    assert small.fx == pytest.approx(40 * 8 / 33)
    assert small.fy == pytest.approx(40 * 6 / 25)
    assert shrunk(camera, 1) == camera
    assert shrunk(camera, 1000).width == 1


def test_sides_that_cannot_be_resampled(tmp_path):
    """OpenCV counts positions of resampled images with 16 bits."""
    content = write_transforms(tmp_path, 2, w=32_800, h=8, fl_x=20_000.0, fl_y=20_000.0, k1=0.01, cx=16_400.0, cy=4.0)
    for frame in content["frames"]:
        write_image(tmp_path / frame["file_path"], np.zeros((8, 32_800), np.uint8))
        (tmp_path / frame["thermal_file_path"]).unlink()
    with pytest.raises(UserError, match=r"frame_.*\.png is 32800x8 and its lens distorted"):
        load_capture(tmp_path)


@pytest.mark.parametrize(
    ("model", "params"), [("PINHOLE", (40.0, 44.0, 16.0, 12.0)), ("SIMPLE_RADIAL", (40.0, 16.0, 12.0, 0.05))]
)
def test_the_camera_is_known_before_the_resampling(model, params):
    """The pinhole camera of a lens takes no maps, and is the one that the images are resampled to."""
    lens = Lens(model, params, 32, 24)
    for size in ((32, 24), (16, 12), (33, 25)):
        assert rectified_camera(lens, *size) == rectification(lens, *size).camera


@pytest.mark.parametrize("model", LENSES)
@pytest.mark.parametrize("scale", [1, 2])
def test_a_camera_with_its_lens_sees_points_where_colmap_does(model: str, scale: int) -> None:
    """For images that stay as they were taken, also of another size than at calibration."""
    camera = camera_through_lens(Lens(model, LENSES[model], 64, 48), 64 * scale, 48 * scale)
    assert camera is not None
    points = np.random.default_rng(1).uniform([-0.5, -0.4, 0.9], [0.5, 0.4, 1.1], (50, 3))
    expected = scale * pycolmap.Camera(model=model, params=LENSES[model], width=64, height=48).img_from_cam(points)
    K = torch.from_numpy(camera.K)
    view = ViewTensors(torch.eye(4), K, 64, 48, lens=lens_tensor(camera, "cpu"), lens_model=camera.lens_model)
    slopes = bent(torch.from_numpy(points[:, :2] / points[:, 2:]), view)
    np.testing.assert_allclose(slopes * K.diagonal()[:2] + K[:2, 2], expected, atol=1e-4)


def test_every_model_of_colmap_is_known() -> None:
    """Whatever a later COLMAP adds has its place in one of the lists above."""
    known = PINHOLES | PANORAMAS | LENSES.keys() | RESAMPLED.keys()
    assert known >= pycolmap.CameraModelId.__members__.keys() - {"INVALID"}
    assert {model for models in RENDERED.values() for model in models} == LENSES.keys()


@pytest.mark.parametrize("model", RESAMPLED)
def test_what_is_not_rendered_through_is_told(model: str, tmp_path: Path) -> None:
    """--lens direct names the models that it knows; without it images are resampled."""
    root = write_rgbt_scenes(tmp_path, 4)
    write_model(synthetic_model(4, camera_model=model, params=_of_size(RESAMPLED[model])), root / "sparse" / "0")
    with pytest.raises(
        UserError, match=f"of the model {model}, which --lens direct does not know; it knows SIMPLE_RADI"
    ):
        load_capture(root, lens="direct")
    capture = load_capture(root)
    assert f"Images of {model} cameras were undistorted to pinhole images in memory." in capture.notes


def _of_size(params: tuple[float, ...]) -> tuple[float, ...]:
    """A camera's parameters for images of half the size: lengths are halved."""
    lengths = 3 if params[1] == 32.0 else 4
    return (*(value / 2 for value in params[:lengths]), *params[lengths:])


@pytest.mark.parametrize("lens", ["undistort", "direct"])
def test_panoramas_are_told_how_to_be_cut(lens: str, tmp_path: Path) -> None:
    """EQUIRECTANGULAR has no focal length, and no pinhole camera sees what it sees."""
    root = write_rgbt_scenes(tmp_path, 4)
    model = synthetic_model(4)
    for number in model.cameras:
        model.cameras[number] = pycolmap.Camera(
            camera_id=number, model="EQUIRECTANGULAR", width=32, height=24, params=[32, 24]
        )
    write_model(model, root / "sparse" / "0")
    with pytest.raises(UserError, match="is EQUIRECTANGULAR: images of 360 degrees are not read") as caught:
        load_capture(root, lens=lens)
    assert "panorama_sfm.py" in (caught.value.hint or "")


def test_images_stay_as_they_were_taken(tmp_path) -> None:
    """With lens="direct" nothing is resampled, the cameras have lenses, and a note says so; a pinhole has none."""
    write_transforms(tmp_path / "barrel", camera_model="OPENCV", k1=-0.2, k2=0.03, p1=0.001, p2=0.0)
    taken, resampled = load_capture(tmp_path / "barrel", lens="direct"), load_capture(tmp_path / "barrel")
    for frame, other in zip(taken.train, resampled.train, strict=True):
        view = frame.views["rgb"]
        assert view.camera.lens is not None
        assert (view.camera.lens.model, view.camera.lens.radial[:2]) == ("pinhole", (-0.2, 0.03))
        assert view.camera.lens.tangential == (0.001, 0.0)
        np.testing.assert_array_equal(view.image, cv2.imread(str(view.path))[..., ::-1])
        assert other.views["rgb"].camera.lens is None
    assert sum("stay as they were taken" in note for note in taken.notes) == 1
    write_transforms(tmp_path / "pinhole")
    pinhole = load_capture(tmp_path / "pinhole", lens="direct")
    assert pinhole.train[0].views["rgb"].camera.lens is None


def test_a_lens_that_the_renderer_does_not_know(tmp_path) -> None:
    """COLMAP's FOV model has no counterpart: the message names those that have."""
    assert camera_through_lens(Lens("FOV", (60.0, 60.0, 32.0, 24.0, 0.9), 64, 48), 64, 48) is None
    root = write_rgbt_scenes(tmp_path)
    params = (40.0, 40.0, 16.0, 12.0, 0.9)
    write_model(synthetic_model(8, camera_model="FOV", params=params), root / "sparse" / "0")
    with pytest.raises(UserError, match="of the model FOV, which --lens direct does not know; it knows SIMPLE_RADIAL"):
        load_capture(root, lens="direct")
