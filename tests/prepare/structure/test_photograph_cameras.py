"""Photographs share a camera where their files say so."""

import math

from thermosplat.datasets.lens import Lens
from thermosplat.prepare.capture_folder import FrameRow
from thermosplat.prepare.structure.photograph_cameras import cameras_of


def test_size_model_and_focal_length_tell_cameras_apart() -> None:
    """Two phones, one of them at two focal lengths, are three cameras."""
    rows = [
        FrameRow("rgb", "a.jpg", "a", 400, 300, make="A", focal_length_35mm=26),
        FrameRow("rgb", "b.jpg", "b", 400, 300, make="A", focal_length_35mm=26),
        FrameRow("rgb", "c.jpg", "c", 400, 300, make="A", focal_length_35mm=52),
        FrameRow("rgb", "d.jpg", "d", 400, 300, make="B"),
    ]
    cameras = cameras_of(rows, None)
    assert [[row.file for row in group] for _, group in cameras] == [["a.jpg", "b.jpg"], ["c.jpg"], ["d.jpg"]]
    # 26 mm on 36x24 mm film, whose diagonal is 43.27 mm; the image's is 500 px
    assert math.isclose(cameras[0][0].mean_focal_length(), 26 / math.hypot(36, 24) * 500)
    assert cameras[0][0].has_prior_focal_length
    assert cameras[2][0].mean_focal_length() == 1.2 * 400
    assert not cameras[2][0].has_prior_focal_length


def test_a_calibrated_lens_holds_for_its_size_only() -> None:
    """Photographs of another size keep their guess."""
    lens = Lens("OPENCV", (310.0, 311.0, 201.0, 149.0, -0.1, 0.01, 0.001, 0.0), 400, 300)
    rows = [FrameRow("rgb", "a.jpg", "a", 400, 300), FrameRow("rgb", "b.jpg", "b", 800, 600)]
    (calibrated, _), (other, _) = cameras_of(rows, lens)
    assert tuple(calibrated.params) == lens.params
    assert other.model.name == "SIMPLE_RADIAL"
