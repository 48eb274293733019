"""Why a photograph has no pose."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2  # noqa: F401  before pycolmap, see datasets/lens.py
import pycolmap

from thermosplat.prepare.structure.matching import opened

FEW_FEATURES = 100
"""Below this many features, a photograph is blurred, dark or without texture."""
_SHOWN = 3


def reasons(database: Path, models: Sequence[pycolmap.Reconstruction]) -> dict[str, list[str]]:
    """Photographs without a pose in the first model, by the reason.

    Args:
        models: All models; the first one is kept.

    Returns:
        Names of photographs for each reason, a clause such as "they match no other photograph".
    """
    registered = {model.images[image_id].name for model in models[:1] for image_id in model.reg_image_ids()}
    elsewhere = {model.images[image_id].name for model in models[1:] for image_id in model.reg_image_ids()}
    found: dict[str, list[str]] = {}
    with opened(database) as connection:
        matched = _matched(connection)
        for image in sorted(connection.read_all_images(), key=lambda image: image.name):
            if image.name in registered:
                continue
            features = connection.num_keypoints_for_image(image.image_id)
            if not connection.exists_keypoints(image.image_id):
                reason = "they cannot be read"
            elif features < FEW_FEATURES:
                reason = f"they have fewer than {FEW_FEATURES} features (blurred, dark or without texture)"
            elif image.name in elsewhere:
                reason = "they match one another but not the others (too little overlap between two parts)"
            elif not matched.get(image.image_id):
                reason = "they match no other photograph (no overlap)"
            else:
                reason = "they see too few points of the model (little overlap, or another place that looks alike)"
            found.setdefault(reason, []).append(image.name)
    return found


def some(names: Iterable[str]) -> str:
    """Names for a sentence: the first three, and how many more there are."""
    every = [name.rsplit("/", 1)[-1] for name in names]
    rest = len(every) - _SHOWN
    return ", ".join(every[:_SHOWN]) + (f" and {rest} more" if rest > 0 else "")


def _matched(connection: pycolmap.Database) -> dict[int, int]:
    """How many photographs each one matches."""
    partners: dict[int, int] = {}
    pair_ids, counts = connection.read_two_view_geometry_num_inliers()
    for pair_id, count in zip(pair_ids, counts):
        if count:
            for image_id in pycolmap.pair_id_to_image_pair(pair_id):
                partners[image_id] = partners.get(image_id, 0) + 1
    return partners
