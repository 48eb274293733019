"""Folders that are no capture, and which layout wins."""

import pytest

from capture_folders import write_rgbt_scenes, write_transforms
from thermosplat.datasets import load_capture
from thermosplat.errors import UserError


def test_missing_folder(tmp_path):
    """A folder that does not exist points to the sample."""
    with pytest.raises(UserError, match="does not exist") as caught:
        load_capture(tmp_path / "none")
    assert "thermosplat-train sample" in caught.value.hint


def test_home_folder(tmp_path, monkeypatch):
    """A ~ that no shell has replaced, as in a YAML file, is the home folder; ~name of nobody is a name."""
    write_rgbt_scenes(tmp_path / "shed")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert load_capture("~/shed").name == "shed"
    with pytest.raises(UserError, match=r"~nobody-of-that-name/shed does not exist"):
        load_capture("~nobody-of-that-name/shed")


def test_file_instead_of_a_folder(tmp_path):
    """A file is said to be one."""
    (tmp_path / "a.zip").write_bytes(b"x")
    with pytest.raises(UserError, match="is a file"):
        load_capture(tmp_path / "a.zip")


def test_no_capture_is_named():
    """No capture named at all."""
    with pytest.raises(UserError, match="No capture given"):
        load_capture("")


def test_unknown_layout_lists_what_was_found(tmp_path):
    """A folder without anything known says what was looked for and what is there."""
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").write_bytes(b"x")
    with pytest.raises(UserError, match="no capture of a known layout") as caught:
        load_capture(tmp_path)
    assert "photos/ (1 files)" in caught.value.message
    assert "rgb/ and thermal/" in caught.value.message


def test_empty_folder(tmp_path):
    """An empty folder is said to be empty."""
    with pytest.raises(UserError, match="Found: nothing"):
        load_capture(tmp_path)


def test_images_and_model_of_different_captures(tmp_path):
    """If no file is in the model, that is what the message says."""
    root = write_rgbt_scenes(tmp_path)
    for path in list(root.glob("*/t*/*.png")):
        path.rename(path.with_name("x" + path.name))
    with pytest.raises(UserError, match=r"No image of .* has a camera"):
        load_capture(root)


def test_rgb_with_a_model_wins_over_transforms(tmp_path):
    """A converted RGBT-Scenes capture may carry a transforms file too."""
    write_rgbt_scenes(tmp_path)
    write_transforms(tmp_path)
    assert load_capture(tmp_path).layout == "rgbt-scenes"
