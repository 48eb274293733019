"""The flat index of an (image, Gaussian) pair, image · N + Gaussian, taken apart.

Dividing by a number that is known at run time takes a GPU some thirty instructions. Mostly there is one image, whose
pairs need none.
"""

import warp as wp


@wp.func
def image_of(index: int, num_gaussians: int):
    """The image of a flat index."""
    image = int(0)
    if index >= num_gaussians:
        image = index // num_gaussians
    return image


@wp.func
def image_and_row(index: int, num_gaussians: int, num_cameras: int):
    """The image of a flat index, and the row of its Gaussian among those of all scenes."""
    image = int(0)
    row = index
    if index >= num_gaussians:
        image = index // num_gaussians
        row = (image // num_cameras) * num_gaussians + index % num_gaussians
    return image, row
