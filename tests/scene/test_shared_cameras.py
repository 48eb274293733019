"""Spectra are rendered together exactly where their cameras agree."""

from dataclasses import replace

import torch

from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.scene.shared_cameras import views_by_camera

VIEW = ViewTensors(torch.eye(4), torch.diag(torch.tensor([50.0, 50.0, 1.0])), 40, 30)


def test_views_of_one_camera_are_one_group() -> None:
    """Equal values are enough; they need not be the same tensors."""
    copied = replace(VIEW, viewmat=VIEW.viewmat.clone(), K=VIEW.K.clone())
    assert views_by_camera({"rgb": VIEW, "nir": copied, "thermal": VIEW}) == [["rgb", "nir", "thermal"]]


def test_any_difference_makes_a_group_of_its_own() -> None:
    """Another size, pose, focal length, lens or shutter is another camera; groups keep the order of the spectra."""
    moved = VIEW.viewmat.clone()
    moved[0, 3] = 0.1
    views = {
        "rgb": VIEW,
        "smaller": replace(VIEW, width=39),
        "moved": replace(VIEW, viewmat=moved),
        "longer": replace(VIEW, K=1.01 * VIEW.K),
        "bent": replace(VIEW, distortion=torch.tensor([0.1, 0.0])),
        "shaken": replace(VIEW, readout=torch.eye(4).expand(2, 4, 4)),
        "nir": VIEW,
        "bent too": replace(VIEW, distortion=torch.tensor([0.1, 0.0])),
        "shaken too": replace(VIEW, readout=torch.eye(4).expand(2, 4, 4).clone()),
        "read upwards": replace(VIEW, readout=torch.eye(4).expand(2, 4, 4), line_order="bottom-to-top"),
    }
    alike = [["bent", "bent too"], ["shaken", "shaken too"]]
    groups = [["rgb", "nir"], ["smaller"], ["moved"], ["longer"], *alike, ["read upwards"]]
    assert views_by_camera(views) == groups
