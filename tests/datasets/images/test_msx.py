"""FLIR MSX is recognised by visible edges in thermal images."""

import cv2
import numpy as np

from capture_folders import pseudo_color, rgb_image, temperatures
from thermosplat.datasets.images.msx import edge_correlation, msx_notes


def pair(number: int, strength: float):
    rgb = rgb_image(number, 64, 48)
    thermal = pseudo_color(temperatures(number, 64, 48)).astype(np.float32)
    luma = rgb.astype(np.float32).mean(-1, keepdims=True)
    detail = luma - cv2.GaussianBlur(luma, (0, 0), 2)[..., None]
    return rgb, np.clip(thermal - strength * detail, 0, 255).astype(np.uint8)


def test_engraved_edges_are_told():
    """Thermal images with the RGB image's detail in them get one note."""
    notes = msx_notes([pair(number, 0.5) for number in range(4)])
    assert len(notes) == 1
    assert "MSX" in notes[0]


def test_true_thermal_images_are_not():
    """Smooth thermal images beside textured RGB ones get none, nor do flat or missing ones."""
    assert msx_notes([pair(number, 0.0) for number in range(4)]) == []
    flat = np.zeros((48, 64, 3), np.uint8)
    assert edge_correlation(rgb_image(0, 64, 48), flat) == 0
    assert msx_notes([(None, flat), (rgb_image(0, 64, 48), None), (rgb_image(0, 8, 8), flat)]) == []
