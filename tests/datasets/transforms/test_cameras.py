"""What the coefficients of transforms files mean: the formulas of nerfstudio and instant-ngp, model by model."""

import json
from pathlib import Path
from typing import Any

import cv2  # noqa: F401  before pycolmap, see thermosplat/datasets/lens.py
import numpy as np
import pytest

from thermosplat.datasets import load_capture
from thermosplat.datasets.lens import Lens
from thermosplat.datasets.transforms.cameras import frame_lens
from thermosplat.errors import UserError

INTRINSICS = {"w": 200, "h": 150, "fl_x": 188.0, "fl_y": 180.0, "cx": 101.0, "cy": 74.0}
SLOPES = np.random.default_rng(0).uniform(-0.5, 0.5, (100, 2))


def lens(**stated: Any) -> Lens:
    return frame_lens({}, {**INTRINSICS, **stated}, Path("transforms.json"), 0, None)


def nerfstudio(planar: np.ndarray, c: dict[str, float]) -> np.ndarray:
    """Where nerfstudio's ``_compute_residual_and_jacobian`` has points of the plane, or of the plane of angles."""
    k1, k2, k3, k4, p1, p2 = (c.get(name, 0.0) for name in ("k1", "k2", "k3", "k4", "p1", "p2"))
    x, y = planar.T
    r = x * x + y * y
    d = 1.0 + r * (k1 + r * (k2 + r * (k3 + r * k4)))
    return np.stack([d * x + 2 * p1 * x * y + p2 * (r + 2 * x * x), d * y + 2 * p2 * x * y + p1 * (r + 2 * y * y)], 1)


def rational(planar: np.ndarray, c: dict[str, float]) -> np.ndarray:
    """COLMAP's FULL_OPENCV, which nerfstudio does not have."""
    r = (planar**2).sum(axis=1, keepdims=True)
    below = 1 + r * (c["k4"] + r * (c["k5"] + r * c["k6"]))
    numerator = {name: c[name] for name in ("k1", "k2", "k3")}
    tangential = nerfstudio(planar, {name: c[name] for name in ("p1", "p2")}) - planar
    return nerfstudio(planar, numerator) / below + tangential


def angles(planar: np.ndarray) -> np.ndarray:
    """Points of the plane at their angles to the axis."""
    r = np.linalg.norm(planar, axis=1, keepdims=True)
    return planar / r * np.arctan(r)


def seen(found: Lens) -> np.ndarray:
    """Where pycolmap has the points of the plane, in the plane of the image."""
    rays = np.concatenate([SLOPES, np.ones((len(SLOPES), 1))], axis=1)
    return (found.colmap_camera().img_from_cam(rays) - (101.0, 74.0)) / (188.0, 180.0)


K = {"k1": -0.1, "k2": 0.02}
P = {"p1": 0.003, "p2": -0.002}
PERSPECTIVE = [
    ("SIMPLE_RADIAL", {"k1": -0.1}),
    ("RADIAL", K),
    ("OPENCV", K | P),
    ("OPENCV", K | P | {"k3": 0.05}),
    (None, K),
]
FISHEYE = [
    ("SIMPLE_RADIAL_FISHEYE", {"k1": -0.1}),
    ("RADIAL_FISHEYE", K),
    ("OPENCV_FISHEYE", K | {"k3": 0.01, "k4": -0.005}),
    ("OPENCV_FISHEYE", K | {"k3": 0.01, "k4": -0.005} | P),
    ("OPENCV_FISHEYE", {}),
]


@pytest.mark.parametrize("listed", [False, True])
@pytest.mark.parametrize(("model", "coefficients"), [*PERSPECTIVE, *FISHEYE])
def test_coefficients_mean_what_nerfstudio_takes_them_for(
    model: str | None, coefficients: dict[str, float], listed: bool
) -> None:
    """By name and as its list of distortion_params."""
    stated: dict[str, Any] = dict(coefficients)
    if listed:
        stated = {"distortion_params": [coefficients.get(name, 0) for name in ("k1", "k2", "k3", "k4", "p1", "p2")]}
    planar = angles(SLOPES) if str(model).endswith("FISHEYE") else SLOPES
    found = lens(camera_model=model, **stated)
    np.testing.assert_allclose(seen(found), nerfstudio(planar, coefficients), atol=1e-9)


def test_full_opencv_is_colmaps() -> None:
    """Its k4 to k6 are the denominator."""
    c = K | P | {"k3": 0.01, "k4": 0.3, "k5": 0.05, "k6": -0.01}
    np.testing.assert_allclose(seen(lens(camera_model="FULL_OPENCV", **c)), rational(SLOPES, c), atol=1e-9)


def test_instant_ngp_says_fisheye_by_a_flag() -> None:
    """Its converter writes all coefficients of all cameras, and zeros for those that a model does not have."""
    zeros = dict.fromkeys(("k1", "k2", "k3", "k4", "p1", "p2"), 0)
    fisheye = K | {"k3": 0.01, "k4": -0.005}
    found = lens(**zeros | fisheye, is_fisheye=True)
    np.testing.assert_allclose(seen(found), nerfstudio(angles(SLOPES), fisheye), atol=1e-9)
    np.testing.assert_allclose(seen(lens(**zeros | K | P, is_fisheye=False)), nerfstudio(SLOPES, K | P), atol=1e-9)


@pytest.mark.parametrize("model", ["PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "FULL_OPENCV", None])
def test_no_distortion_is_a_pinhole(model: str | None) -> None:
    """Whatever the file calls it."""
    assert lens(camera_model=model, k1=0, p1=0.0, k4=None) == Lens("PINHOLE", (188.0, 180.0, 101.0, 74.0), 200, 150)


def test_a_field_of_view_is_enough() -> None:
    """One of each axis where both are stated."""
    content = {"w": 200, "h": 150, "camera_angle_x": 1.0, "camera_angle_y": 0.7}
    found = frame_lens({}, content, Path("transforms.json"), 0, None)
    np.testing.assert_allclose(found.params, [100 / np.tan(0.5), 75 / np.tan(0.35), 100, 75])


@pytest.mark.parametrize(
    ("stated", "said"),
    [
        ({"camera_model": "OPENCV", "k4": 0.3}, r"OPENCV and k4 = 0.3, which is none of its coefficients \(k1, k2, p1"),
        ({"camera_model": "OPENCV", "k3": 1e-6, "k4": 0.3}, "OPENCV and k4 = 0.3"),
        ({"k4": 0.3}, "OPENCV and k4 = 0.3"),
        ({"camera_model": "RADIAL", "distortion_params": [0, 0, 0, 0.3, 0, 0]}, "RADIAL and k4 = 0.3"),
        ({"camera_model": "PINHOLE", "k1": 0.1}, r"PINHOLE and k1 = 0.1, .* \(it has none\)"),
        ({"camera_model": "OPENCV", "k6": 0.1}, "OPENCV and k6 = 0.1"),
        ({"camera_model": "FULL_OPENCV", "s1": 0.1}, "FULL_OPENCV and s1 = 0.1"),
        ({"camera_model": "OPENCV_FISHEYE", "k5": 0.1}, "OPENCV_FISHEYE and k5 = 0.1"),
        ({"camera_model": "OPENCV", "is_fisheye": True}, "OPENCV and says is_fisheye"),
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR: images of 360 degrees are not read"),
        ({"camera_model": "OMNIDIRECTIONALSTEREO_L"}, "images of 360 degrees are not read"),
        ({"camera_model": "VR180_R"}, "images of 360 degrees are not read"),
        ({"equirectangular": True}, "equirectangular: images of 360 degrees are not read"),
        ({"latlong": True}, "images of 360 degrees are not read"),
        ({"camera_model": "ORTHOPHOTO"}, "the camera model 'ORTHOPHOTO', which is not known"),
        ({"camera_model": "FISHEYE624", "distortion_params": [0.0] * 12}, "'FISHEYE624', which is not known"),
        ({"camera_model": "THIN_PRISM_FISHEYE"}, "'THIN_PRISM_FISHEYE', which is not known"),
        ({"orthographic": True}, "'orthographic', which is not known"),
        ({"ftheta_p0": 0.1}, "'ftheta_p0', which is not known"),
        ({"distortion_params": [0.1, 0.2]}, "distortion_params that are no list of k1, k2, k3, k4, p1, p2"),
        ({"distortion_params": "none"}, "distortion_params that are no list"),
    ],
)
def test_what_has_no_place_is_told(stated: dict[str, Any], said: str) -> None:
    """No coefficient is dropped or read as another one."""
    with pytest.raises(UserError, match=said) as caught:
        lens(**stated)
    assert caught.value.hint


def test_the_message_reaches_who_loads(tmp_path: Path) -> None:
    """From a capture's folder; per frame as well as for all."""
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "0.jpg").touch()
    frame = {"file_path": "images/0.jpg", "transform_matrix": np.eye(4).tolist(), "k4": 0.3}
    (tmp_path / "transforms.json").write_text(json.dumps({**INTRINSICS, "camera_model": "OPENCV", "frames": [frame]}))
    with pytest.raises(UserError, match=r"Frame 0 of .*transforms.json has the camera model OPENCV and k4 = 0.3"):
        load_capture(tmp_path)
