"""The hold-out rule."""

import pytest

from thermosplat.datasets.frame_files import FrameFiles
from thermosplat.datasets.splits import divide, hold_out_mask
from thermosplat.errors import UserError


def frames(*splits):
    return [FrameFiles(str(number), {}, split) for number, split in enumerate(splits)]


def test_every_nth_from_the_first():
    """idx % test_every == 0, the rule of RGBT-Scenes and 3DGS."""
    mask = hold_out_mask(frames(*[None] * 10), 4)
    assert [index for index, held_out in enumerate(mask) if held_out] == [0, 4, 8]


def test_folders_win():
    """Stated splits are kept whatever test_every says."""
    assert hold_out_mask(frames("train", "test", "train"), 2) == [False, True, False]


@pytest.mark.parametrize(("splits", "empty"), [(("train", "train"), "test/"), (("test", "test"), "train/")])
def test_an_empty_folder_is_told(splits, empty):
    """A split without images is an error that names the folder."""
    with pytest.raises(UserError, match=f"{empty} is empty"):
        hold_out_mask(frames(*splits), 8)


@pytest.mark.parametrize(("count", "test_every"), [(8, 1), (8, 0), (1, 8)])
def test_no_training_view_left(count, test_every):
    """test_every=1 would hold out everything, as would a single image."""
    with pytest.raises(UserError, match="no training view"):
        hold_out_mask(frames(*[None] * count), test_every)


def test_two_frames_and_every_second_are_the_least():
    """One is held out, one is trained on."""
    assert hold_out_mask(frames(None, None), 2) == hold_out_mask(frames(None, None), 8) == [True, False]


def test_dividing_keeps_the_order():
    """Order is kept on both sides."""
    assert divide("abcd", [True, False, True, False]) == (("b", "d"), ("a", "c"))
