"""Label images of a capture, seen from anywhere: which surface a pixel of a view belongs to.

Beside a label file (``read_labels``) lies a folder ``labels/`` with ``<image's name>.png`` for some of the images, in
their pixels, grey values being labels. Rendered captures have labels in their ground truth, which are taken where that
folder does not exist. A view that was not labelled itself has the labels of the labelled ones next to it, wherever
these see the same point.
"""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from thermosplat.datasets.capture import Capture, Frame, View
from thermosplat.datasets.frame_tensors import ViewTensors, view_tensors
from thermosplat.datasets.ground_truth import read_ground_truth
from thermosplat.datasets.images.image_files import read_image
from thermosplat.errors import UserError
from thermosplat.scene.model import SceneModel
from thermosplat.thermography.reprojection import pixel_rays, pose_distances, sampled, seen_from, warped

FOLDER = "labels"
UNLABELLED = -1
"""Of pixels that no labelled image shows."""
_NEAREST = 4
"""Labelled images that a view asks, the nearest first."""
_SAME_POSE = 1e-4
"""As of the viewer's photographs: distance of poses below which depth does not matter."""


class LabelImages:
    """The label images of a spectrum.

    Args:
        capture: The capture.
        model: The scene, which says what hides what.
        spectrum: Whose images are labelled.
        beside: The label file.
        device: Where the model is.

    Raises:
        UserError: No image of the capture is labelled.
    """

    def __init__(
        self, capture: Capture, model: SceneModel, spectrum: str, beside: Path, device: torch.device | str
    ) -> None:
        self._model, self._spectrum, self._device, self._capture = model, spectrum, device, capture
        self._folder = beside.parent / FOLDER
        frames = [frame for frame in (*capture.train, *capture.test) if spectrum in frame.views]
        self._labelled = [frame for frame in frames if self._has_labels(frame)]
        if not self._labelled:
            wanted = self._folder / f"{frames[0].views[spectrum].name}.png" if frames else self._folder
            raise UserError(
                f"{beside} speaks of labels, and no image of {capture.root} is labelled (such as {wanted}).",
                "Put label images there, 8-bit PNGs in the pixels of the images.",
            )
        self._poses = np.stack([frame.views[spectrum].viewmat for frame in self._labelled])
        places = np.linalg.inv(np.stack([frame.views[spectrum].viewmat for frame in frames]))[:, :3, 3]
        between = np.linalg.norm(places[:, None] - places[None], axis=-1)
        np.fill_diagonal(between, np.inf)
        self._spacing = float(np.median(between.min(axis=1))) if len(places) > 1 else 1.0
        self._read = lru_cache(maxsize=8)(self._read_anew)

    def seen_in(self, view: ViewTensors, depth: Tensor) -> NDArray[np.int64]:
        """Labels of a view's pixels, [H, W]; ``UNLABELLED`` where no labelled image shows what is there.

        Args:
            view: The view.
            depth: z-depth that the spectrum has there, [H, W].
        """
        found = torch.full((view.height, view.width), float(UNLABELLED), device=self._device)
        if view.orthographic:
            return found.cpu().numpy().astype(np.int64)
        apart = pose_distances(self._poses, view.viewmat.cpu().numpy(), self._spacing)
        for index in np.argsort(apart)[:_NEAREST]:
            labels, taken = self._read(int(index))
            if apart[index] <= _SAME_POSE:
                positions, _ = seen_from(taken, view, pixel_rays(view))
                seen = sampled(labels, positions, "nearest")[..., 0]
            else:
                seen = warped(self._model, self._spectrum, labels, taken, view, depth, "nearest")[..., 0]
            found = torch.where((found == UNLABELLED) & seen.isfinite(), seen, found)
        return found.round().cpu().numpy().astype(np.int64)

    def _has_labels(self, frame: Frame) -> bool:
        if self._folder.is_dir():
            return self._file(frame.views[self._spectrum]).is_file()
        return read_ground_truth(self._capture, frame) is not None

    def _file(self, view: View) -> Path:
        return self._folder / f"{view.name}.png"

    def _read_anew(self, index: int) -> tuple[Tensor, ViewTensors]:
        frame = self._labelled[index]
        view = frame.views[self._spectrum]
        if self._folder.is_dir():
            labels = read_image(self._file(view))
            if labels.ndim != 2 or labels.dtype != np.uint8:
                raise UserError(
                    f"{self._file(view)} is no label image: it has {labels.dtype} of shape {list(labels.shape)}.",
                    "Expected 8-bit grey values, each of them a label.",
                )
        else:
            truth = read_ground_truth(self._capture, frame)
            assert truth is not None  # noqa: S101  such frames alone are listed
            labels = truth.label
        image = torch.as_tensor(labels.astype(np.float32), device=self._device)[..., None]
        taken = view_tensors(replace(view, values=None, mask=None), None, self._device)
        scale = torch.tensor([[image.shape[1] / taken.width], [image.shape[0] / taken.height], [1.0]])
        camera = replace(taken, K=taken.K * scale.to(taken.K.device), width=image.shape[1], height=image.shape[0])
        return image, replace(camera, image=None)
