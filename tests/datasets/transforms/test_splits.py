"""Lists of file names in a transforms file."""

import json

import pytest

from capture_folders import write_transforms
from thermosplat.datasets import load_capture
from thermosplat.errors import UserError


def load(root, **lists):
    """A capture of 8 frames with these lists; numbers stand for the frames' file_path."""
    content = write_transforms(root)
    paths = [frame["file_path"] for frame in content["frames"]]
    stated = {
        key: names if isinstance(names, str) else [paths[name] if isinstance(name, int) else name for name in names]
        for key, names in lists.items()
    }
    (root / "transforms_thermal.json").write_text(json.dumps(content | stated))
    return load_capture(root)


def numbers(frames):
    return [int(frame.name[-1]) for frame in frames]


def test_frames_in_no_list_are_left_out(tmp_path):
    """Neither trained on nor held out, and said."""
    capture = load(tmp_path, train_filenames=[1, 2], val_filenames=[3], test_filenames=[5])
    assert numbers(capture.train) == [1, 2]
    assert numbers(capture.test) == [3, 5]
    note = next(note for note in capture.notes if "none of its lists" in note)
    assert note.startswith("4 of 8 frames")
    assert "images/frame_eval_00000.png" in note


def test_names_are_compared_as_paths(tmp_path):
    """With ./, without ending, absolute, or the bare name where one frame has it."""
    absolute = str(tmp_path / "images" / "frame_train_00003.png")
    names = ["./images/frame_train_00001.png", "images/frame_train_00002", absolute, "frame_train_00005.png"]
    assert numbers(load(tmp_path, train_filenames=names, test_filenames=[0]).train) == [1, 2, 3, 5]


def test_one_stem_in_several_folders(tmp_path):
    """images/a/0.png is trained on, images/b/0.png is held out."""
    content = write_transforms(tmp_path, 2)
    for frame, folder in zip(content["frames"], "ab", strict=True):
        for key in ("file_path", "thermal_file_path"):
            path = tmp_path / frame[key].split("/")[0] / folder / "0.png"
            path.parent.mkdir()
            (tmp_path / frame[key]).rename(path)
            frame[key] = path.relative_to(tmp_path).as_posix()
    content |= {"train_filenames": ["images/a/0.png"], "test_filenames": ["images/b/0.png"]}
    (tmp_path / "transforms_thermal.json").write_text(json.dumps(content))
    capture = load_capture(tmp_path)
    assert [frame.views["rgb"].path.parent.name for frame in (*capture.train, *capture.test)] == ["a", "b"]
    content |= {"train_filenames": ["0.png"]}
    (tmp_path / "transforms_thermal.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match=r"names 1 images that fit none of its frames, or several \(first: 0\.png\)"):
        load_capture(tmp_path)


@pytest.mark.parametrize(
    ("lists", "says"),
    [
        (
            {"train_filenames": [1, "images/gone.png"], "test_filenames": [0]},
            r"train_filenames of .*transforms_thermal\.json names 1 images .* \(first: images/gone\.png\)",
        ),
        ({"train_filenames": [*range(8)]}, r"lists no held-out images \(val_filenames, test_filenames\)"),
        ({"test_filenames": [0]}, r"lists no training images \(train_filenames\)"),
        ({"train_filenames": "images", "test_filenames": [0]}, "must be a list of file names"),
    ],
)
def test_lists_that_cannot_be_used(tmp_path, lists, says):
    """Unknown names and a missing side are errors about lists, not about folders."""
    with pytest.raises(UserError, match=says) as caught:
        load(tmp_path, **lists)
    assert "remove the lists" in caught.value.hint
    assert "folder" not in str(caught.value)


def test_lists_of_images_that_are_gone(tmp_path):
    """No held-out image has a file."""
    content = write_transforms(tmp_path)
    for folder in ("images", "thermal"):
        (tmp_path / folder / "frame_eval_00000.png").unlink()
    paths = [frame["file_path"] for frame in content["frames"]]
    content |= {"train_filenames": paths[1:], "test_filenames": paths[:1]}
    (tmp_path / "transforms_thermal.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match="none of the 1 held-out images that it lists exists"):
        load_capture(tmp_path)


def test_frames_in_both_lists_are_held_out(tmp_path):
    """What is evaluated is not trained on."""
    capture = load(tmp_path, train_filenames=[0, 1, 2], test_filenames=[0])
    assert numbers(capture.train) == [1, 2]
    assert any("1 of 8 frames" in note and "they are held out" in note for note in capture.notes)


def test_all_training_images_are_held_out_too(tmp_path):
    """The list of training images is there, and says what is wrong with it."""
    with pytest.raises(UserError, match=r"All 3 images of train_filenames of .* are in a list of held-out images, too"):
        load(tmp_path, train_filenames=[0, 1, 2], val_filenames=[0, 1, 2, 3])
