"""Small captures in every layout, written to a folder for the tests of the readers."""

import json
from pathlib import Path

import cv2  # before pycolmap, see thermosplat/datasets/lens.py
import numpy as np
import pycolmap

from thermosplat.radiometry import FLIR_IRON

WIDTH, HEIGHT = 32, 24


def synthetic_model(
    count: int,
    *,
    camera_model: str = "PINHOLE",
    params: tuple[float, ...] = (40.0, 42.0, 16.0, 12.0),
    cameras: int = 1,
    rigs: int = 1,
) -> pycolmap.Reconstruction:
    """A COLMAP model of `count` frames a rig; images are called 0000.png ... or, with two cameras a rig, rgb/0000.png
    and thermal/0000.png."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = rigs, cameras, count
    options.num_points3D, options.num_points2D_without_point3D = 30, 0
    options.camera_model_id = getattr(pycolmap.CameraModelId, camera_model)
    options.camera_params, options.camera_width, options.camera_height = list(params), WIDTH, HEIGHT
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(options)
    for image in model.images.values():
        number = f"{image.frame_id - 1:04d}.png"
        image.name = number if cameras == 1 else f"{'rgb' if image.camera_id == 1 else 'thermal'}/{number}"
    return model


def write_model(model: pycolmap.Reconstruction, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(folder)


def write_image(path: Path, image: np.ndarray) -> None:
    """Write an RGB or one-channel image."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), image if image.ndim == 2 else np.ascontiguousarray(image[..., ::-1])):
        raise OSError(path)


def rgb_image(number: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    return np.random.default_rng(number).integers(0, 256, (height, width, 3), np.uint8)


def temperatures(number: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """A smooth field between 15 and 35 °C, another one for each frame."""
    x, y = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
    return 25 + 10 * np.sin(3 * x + number) * np.cos(2 * y)


def pseudo_color(celsius: np.ndarray, low: float = 15.0, high: float = 35.0) -> np.ndarray:
    return np.round(FLIR_IRON.to_color((celsius - low) / (high - low)) * 255).astype(np.uint8)


def centikelvin(celsius: np.ndarray) -> np.ndarray:
    return np.round((celsius + 273.15) * 100).astype(np.uint16)


def write_rgbt_scenes(root: Path, count: int = 8, *, folders: bool = True, raw: bool = False) -> Path:
    """An RGBT-Scenes capture; with `folders` in train/ and test/ (every fourth), with `raw` 16-bit centikelvin."""
    write_model(synthetic_model(count), root / "sparse" / "0")
    for number in range(count):
        split = ("test" if number % 4 == 0 else "train") if folders else "."
        write_image(root / "rgb" / split / f"{number:04d}.png", rgb_image(number))
        write_image(root / "thermal" / split / f"{number:04d}.png", pseudo_color(temperatures(number)))
        if raw:
            write_image(root / "thermal_raw" / f"{number:04d}.png", centikelvin(temperatures(number)))
    if raw:
        statement = {"unit": "centi-Kelvin", "palette_min_C": 15.0, "palette_max_C": 35.0}
        (root / "thermal_raw" / "units.json").write_text(json.dumps(statement))
    return root


def write_colmap_folder(root: Path, count: int = 8) -> Path:
    """images/ and a model, without any thermal image yet."""
    write_model(synthetic_model(count), root / "sparse" / "0")
    for number in range(count):
        write_image(root / "images" / f"{number:04d}.png", rgb_image(number))
    return root


def write_transforms(root: Path, count: int = 8, **intrinsics: object) -> dict:
    """A ThermoScenes capture: transforms_thermal.json, images/, grey thermal/, temperature_bounds.json."""
    frames = []
    for number in range(count):
        name = f"frame_{'eval' if number % 4 == 0 else 'train'}_{number:05d}"
        write_image(root / "images" / f"{name}.png", rgb_image(number))
        write_image(root / "thermal" / f"{name}.png", np.full((HEIGHT, WIDTH), 10 * number, np.uint8))
        pose = np.eye(4)
        pose[:3, 3] = (number, 0.5, 2.0)
        frames.append(
            {
                "file_path": f"images/{name}.png",
                "thermal_file_path": f"thermal/{name}.png",
                "transform_matrix": pose.tolist(),
            }
        )
    content = {"w": WIDTH, "h": HEIGHT, "fl_x": 40.0, "fl_y": 60.0, "cx": 15.0, "cy": 12.5, "frames": frames}
    content |= intrinsics
    (root / "transforms_thermal.json").write_text(json.dumps(content))
    bounds = {"absolute_min_temperature": -10.0, "absolute_max_temperature": 41.0}
    (root / "temperature_bounds.json").write_text(json.dumps(bounds))
    return content
