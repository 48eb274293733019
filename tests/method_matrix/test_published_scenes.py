"""Collections of captures that were published, as folders on a disk."""

from collections.abc import Callable
from pathlib import Path

import pytest

from thermosplat.errors import UserError
from thermosplat.method_matrix.cells import parse_scenes
from thermosplat.method_matrix.published_scenes import COLLECTIONS, expand_collections


def make_rgbt_scene(folder: Path, train: int = 1, test: int = 1) -> None:
    for spectrum in ("rgb", "thermal"):
        for part, count in (("train", train), ("test", test)):
            (folder / spectrum / part).mkdir(parents=True)
            for index in range(count):
                (folder / spectrum / part / f"{index}.jpg").touch()
    (folder / "colmap/sparse/0").mkdir(parents=True)


def make_thermoscene(folder: Path) -> None:
    (folder / "images").mkdir(parents=True)
    (folder / "thermal").mkdir()
    (folder / "transforms_thermal.json").write_text("{}")


@pytest.mark.parametrize(("word", "make"), [("rgbt-scenes", make_rgbt_scene), ("thermoscenes", make_thermoscene)])
def test_a_collection_stands_for_its_scenes(word: str, make: Callable[[Path], None], tmp_path: Path) -> None:
    """All of its folders under their published names, however a copy writes them; other words stay."""
    published = list(COLLECTIONS[word].scenes)
    for name in published:
        make(tmp_path / "all" / name.upper())
    (tmp_path / "all" / "something_else").mkdir()
    words, notes = expand_collections(["sample", f"{word}={tmp_path / 'all'}"])
    scenes = parse_scenes(words)
    assert [scene.name for scene in scenes] == ["sample", *published]
    assert Path(scenes[1].data) == tmp_path / "all" / published[0].upper()
    assert not [note for note in notes if "Missing" in note]


def test_missing_scenes_and_other_counts_are_told(tmp_path: Path) -> None:
    """Which scenes are not there, and whose photographs are not as many as were published."""
    make_rgbt_scene(tmp_path / "Ebike", 42, 6)
    make_rgbt_scene(tmp_path / "IronIngot", 53, 7)
    words, notes = expand_collections([f"rgbt-scenes={tmp_path}"])
    assert len(words) == 2
    missing, counts = notes
    assert "2 of the 10 scenes" in missing
    assert "Truck" in missing
    assert "Ebike" not in missing
    assert "53 training and 7 test photographs. Published: 53 and 8" in counts


@pytest.mark.parametrize("part", ["thermal/test", "colmap"])
def test_a_scene_that_is_not_whole_is_refused(part: str, tmp_path: Path) -> None:
    """By its name and by what it lacks."""
    make_rgbt_scene(tmp_path / "Ebike")
    (tmp_path / "Ebike" / part).rename(tmp_path / "elsewhere")
    with pytest.raises(UserError, match=r"Ebike lacks (thermal/test/|sparse/0/)"):
        expand_collections([f"rgbt-scenes={tmp_path}"])


def test_a_folder_without_scenes_is_refused(tmp_path: Path) -> None:
    """With what was expected there; so is a folder that is not there."""
    (tmp_path / "photos").mkdir()
    with pytest.raises(UserError, match=r"none of the scenes of ThermoScenes\. Expected folders: buildingA_spring"):
        expand_collections([f"thermoscenes={tmp_path}"])
    with pytest.raises(UserError, match="There is no folder"):
        expand_collections([f"rgbt-scenes={tmp_path / 'nowhere'}"])
