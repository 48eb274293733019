"""Parameters rounded to half precision where no training image shows it, so that they are stored in half the bytes.

float16 has 11 bits: angles to 5e-4, opacities and sizes to half a percent, colours to a thousandth. Positions keep
float32: theirs must be fine against a pixel, in a scene of any size.
"""

import torch

from thermosplat.scene.model import SceneModel
from thermosplat.training.budget.image_change import ImageChange

_FULL = "means"


@torch.no_grad()
def round_to_half(model: SceneModel, change: ImageChange, tolerance: float) -> list[str]:
    """Round parameter after parameter, the largest first, as long as all of it together changes the images little.

    Args:
        model: The scene. Rounded parameters hold numbers that float16 has, still as float32.
        change: The images from before.
        tolerance: Largest change (``ImageChange.now``).

    Returns:
        The parameters that were rounded, by set and name.
    """
    rounded = []
    for owner in model.gaussian_sets:
        gaussians = model.gaussians(owner)
        for name, parameter in sorted(gaussians.named_parameters(), key=lambda item: -item[1].numel()):
            if name == _FULL:
                continue
            saved = parameter.clone()
            parameter.copy_(parameter.half())
            if bool(parameter.isfinite().all()) and change.now() <= tolerance:
                rounded.append(f"{owner}.{name}")
            else:
                parameter.copy_(saved)
    return rounded
