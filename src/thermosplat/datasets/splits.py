"""Which frames are held out for evaluation."""

from collections.abc import Sequence
from typing import TypeVar

from thermosplat.datasets.frame_files import FrameFiles
from thermosplat.errors import UserError

T = TypeVar("T")


def hold_out_mask(frames: Sequence[FrameFiles], test_every: int) -> list[bool]:
    """Whether each frame is held out: as the folders say, else every `test_every`-th from the first (as 3DGS does).

    Args:
        frames: All frames, sorted by name.
        test_every: Period of the hold-out rule.

    Raises:
        UserError: Training or test views would be missing.
    """
    if any(frame.split is not None for frame in frames):
        mask = [frame.split == "test" for frame in frames]
        for held_out, split in ((True, "test"), (False, "train")):
            if held_out not in mask:
                raise UserError(
                    f"The folders divide the {len(frames)} images into training and test, but {split}/ is empty.",
                    f"Move images into {split}/, or all of them one folder up: then every "
                    f"{test_every}-th is held out (--test-every).",
                )
        return mask
    if test_every < 2:
        raise UserError(f"--test-every must be at least 2, got {test_every}: it would leave no training view.")
    if len(frames) < 2:
        raise UserError(
            f"test_every={test_every} with {len(frames)} image leaves no training view.",
            "A capture needs two exposures at least, one to learn from and one to be held out.",
        )
    return [index % test_every == 0 for index in range(len(frames))]


def divide(items: Sequence[T], mask: Sequence[bool]) -> tuple[tuple[T, ...], tuple[T, ...]]:
    """Items for training (mask False) and for test (mask True)."""
    train = tuple(item for item, held_out in zip(items, mask, strict=True) if not held_out)
    test = tuple(item for item, held_out in zip(items, mask, strict=True) if held_out)
    return train, test
