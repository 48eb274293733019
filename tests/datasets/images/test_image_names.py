"""Which images belong together by their names, and what frames are called."""

from collections.abc import Sequence
from pathlib import PurePosixPath

import pytest

from thermosplat.datasets.images.image_names import NamedImages, exposures, frame_names
from thermosplat.errors import UserError


def paths(words: str) -> list[PurePosixPath]:
    return [PurePosixPath(word) for word in words.split()]


def named(where: str, words: str, **options: bool) -> NamedImages[None]:
    return NamedImages(where, [(name, None) for name in paths(words)], **options)


@pytest.mark.parametrize(
    ("rgb", "thermal", "expected"),
    [
        ("1.jpg 2.jpg", "1.png 2.png", ["1.jpg 1.png", "2.jpg 2.png"]),
        ("train/1.jpg test/2.jpg", "1.png 2.png", ["test/2.jpg 2.png", "train/1.jpg 1.png"]),
        ("train/1.jpg", "test/1.png", ["train/1.jpg test/1.png"]),
        ("rgb/train/1.jpg", "thermal/train/1.png", ["rgb/train/1.jpg thermal/train/1.png"]),
        ("train/1.jpg test/1.jpg", "train/1.png test/1.png", ["test/1.jpg test/1.png", "train/1.jpg train/1.png"]),
        ("train/1.jpg test/1.jpg", "train/1.png", ["test/1.jpg None", "train/1.jpg train/1.png"]),
        ("train/1.jpg", "train/1.png test/1.png", ["None test/1.png", "train/1.jpg train/1.png"]),
        (
            "train/a/1.jpg test/a/1.jpg",
            "a/train/2.png",
            ["None a/train/2.png", "test/a/1.jpg None", "train/a/1.jpg None"],
        ),
        ("1.jpg 1.png", "2.png", ["1.jpg None", "1.png None", "None 2.png"]),
    ],
)
def test_images_of_one_exposure(rgb: str, thermal: str, expected: Sequence[str]) -> None:
    """Stems pair, whatever the split and the ending; where both spectra have a stem twice, the splits pair as well."""
    found = exposures({"rgb": named("rgb/", rgb), "thermal": named("thermal/", thermal)})
    pairs = [f"{exposure.names.get('rgb')} {exposure.names.get('thermal')}" for exposure in found]
    assert sorted(pairs) == sorted(expected)
    for exposure in found:
        assert exposure.leading == ("rgb" if "rgb" in exposure.names else "thermal")
        assert exposure.name == exposure.names[exposure.leading]


@pytest.mark.parametrize(
    ("rgb", "thermal", "said"),
    [
        ("test/1.jpg train/1.jpg", "1.png", r"test/1\.jpg and train/1\.jpg of rgb/ .* 1\.png of thermal/ may"),
        ("1.jpg", "test/1.png train/1.png", r"test/1\.png and train/1\.png of thermal/ .* 1\.jpg of rgb/ may"),
        (
            "1.jpg",
            "1.jpg 1.tiff",
            r"1\.jpg and 1\.tiff of thermal/ have one stem, and 1\.jpg of rgb/ may belong to eit",
        ),
        ("a/1.jpg a/1.png", "a/1.png", r"a/1\.jpg and a/1\.png of rgb/ have one stem, and a/1\.png of thermal/ may"),
    ],
)
def test_images_that_nothing_tells_apart(rgb: str, thermal: str, said: str) -> None:
    """Two files that would have been one are named, and what may belong to either."""
    with pytest.raises(UserError, match=said) as caught:
        exposures({"rgb": named("rgb/", rgb), "thermal": named("thermal/", thermal)})
    assert "Rename them" in caught.value.hint


@pytest.mark.parametrize(
    ("registered", "files", "expected"),
    [
        ("input/1.JPG input/2.JPG", "train/1.png test/2.png", "input/1.JPG input/2.JPG"),
        ("train/1.jpg test/1.jpg", "train/1.png test/1.png", "train/1.jpg test/1.jpg"),
        ("train/1.jpg", "train/1.jpg test/1.jpg", "train/1.jpg None"),
        ("train/1.jpg test/1.jpg", "train/1.jpg", "train/1.jpg"),
        ("a/1.jpg", "a/1.jpg a/1.png", "a/1.jpg None"),
        ("a/1.jpg a/1.png", "a/1.jpg a/1.png", "a/1.jpg a/1.png"),
        ("1.jpg", "1.jpg rgb/1.jpg", "1.jpg None"),
        ("a/1.jpg", "a/1.jpg b/1.jpg", "a/1.jpg None"),
        ("a/1.jpg b/1.jpg", "c/1.jpg", "None"),
    ],
)
def test_files_among_registered_images(registered: str, files: str, expected: str) -> None:
    """Splits, endings and whole names tell them apart; a bare stem does where only one image and one file has it."""
    model = named("the COLMAP model", registered, same_files=True, by_stem=True)
    folder = named("rgb/", files)
    assert [str(model.find(name, folder)) for name in folder] == expected.split()


@pytest.mark.parametrize(
    ("registered", "files"),
    [("1.jpg", "test/1.jpg train/1.jpg"), ("input/1.jpg", "test/1.jpg train/1.jpg"), ("2/1.jpg", "a/1.jpg b/1.jpg")],
)
def test_a_registered_image_that_may_be_either(registered: str, files: str) -> None:
    """It is nobody's, and not that of whichever file comes last."""
    model = named("the COLMAP model", registered, same_files=True, by_stem=True)
    folder = named("rgb/", files)
    for name in folder:
        with pytest.raises(UserError, match=rf" of rgb/ have one stem, and {registered} of the COLMAP model may"):
            model.find(name, folder)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ("train/1.jpg test/2.jpg", "1 2"),
        ("left/1.jpg right/1.jpg", "left_1 right_1"),
        ("train/1.jpg test/1.jpg train/2.jpg", "train_1 test_1 train_2"),
        ("rgb/1.jpg thermal/1.jpg", "rgb_1 thermal_1"),
        ("a/1.jpg a/1.png 2.png", "a_1.jpg a_1.png 2.png"),
        ("1.jpg 1.jpg", "1 1"),
    ],
)
def test_frames_are_called_apart(names: str, expected: str) -> None:
    """As briefly as that goes, all in one way."""
    assert frame_names(paths(names), "the COLMAP model") == expected.split()


def test_frames_that_cannot_be_called_apart() -> None:
    """Output files would overwrite each other."""
    with pytest.raises(UserError, match=r"a/1\.jpg and a_1\.jpg of images/ would both be called a_1\.jpg"):
        frame_names(paths("a/1.jpg a_1.jpg"), "images/")
