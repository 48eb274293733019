"""Images and rows of flat indices."""

import numpy as np
import warp as wp

from warp_kernels.machinery.flat_index import image_and_row, image_of


@wp.kernel(enable_backward=False, module="unique")
def take_apart(
    num_gaussians: int,
    num_cameras: int,
    images: wp.array(dtype=wp.int32),  # [images · N]
    rows: wp.array(dtype=wp.int32),  # [images · N]
    again: wp.array(dtype=wp.int32),  # [images · N]
):
    index = wp.tid()
    image, row = image_and_row(index, num_gaussians, num_cameras)
    images[index] = image
    rows[index] = row
    again[index] = image_of(index, num_gaussians)


def test_of_scenes_with_cameras() -> None:
    """Three scenes of five Gaussians with two cameras each: cameras of a scene share its rows."""
    scenes, cameras, gaussians = 3, 2, 5
    found = [wp.empty(scenes * cameras * gaussians, dtype=wp.int32, device="cpu") for _ in range(3)]
    wp.launch(take_apart, len(found[0]), [gaussians, cameras, *found], device="cpu")
    scene, camera, gaussian = np.unravel_index(np.arange(len(found[0])), (scenes, cameras, gaussians))
    assert (found[0].numpy() == scene * cameras + camera).all()
    assert (found[1].numpy() == scene * gaussians + gaussian).all()
    assert (found[2].numpy() == found[0].numpy()).all()
