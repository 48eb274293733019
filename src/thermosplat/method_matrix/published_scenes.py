"""Published collections of captures: which scenes they have, and whether a folder holds them. Imports nothing heavy.

Neither collection may be shipped, so whoever has one names its folder: ``rgbt-scenes=FOLDER``.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from thermosplat.config.files import data_from_anywhere
from thermosplat.errors import UserError

_PICTURES = frozenset({".jpg", ".jpeg", ".png"})


@dataclass(frozen=True)
class Collection:
    """Captures that were published together."""

    title: str
    scenes: Mapping[str, tuple[int, int] | None]
    """Numbers of training and test pairs by the name of the scene's folder; None where they are not known."""
    lacking: Callable[[Path], list[str]]
    """What a scene's folder lacks, each as it would be named in a listing."""


def _rgbt_scenes_lack(folder: Path) -> list[str]:
    wanted = [f"{spectrum}/{part}" for spectrum in ("rgb", "thermal") for part in ("train", "test")]
    missing = [f"{name}/" for name in wanted if not (folder / name).is_dir()]
    models = [folder / "sparse", folder / "colmap"]
    return missing if any(model.is_dir() for model in models) else [*missing, "sparse/0/"]


def _thermoscenes_lack(folder: Path) -> list[str]:
    missing = [f"{name}/" for name in ("images", "thermal") if not (folder / name).is_dir()]
    names = ("transforms_thermal.json", "transforms.json")
    return missing if any((folder / name).is_file() for name in names) else [*missing, names[0]]


COLLECTIONS = {
    "rgbt-scenes": Collection(
        "RGBT-Scenes",
        {
            "Dimsum": (134, 20),
            "DailyStuff": (68, 10),
            "Ebike": (42, 6),
            "RoadBlock": (62, 9),
            "Truck": (64, 9),
            "RotaryKiln": (92, 14),
            "Building": (238, 35),
            "IronIngot": (53, 8),
            "Parterre": (57, 9),
            "LandScape": (90, 13),
        },
        _rgbt_scenes_lack,
    ),
    "thermoscenes": Collection(
        "ThermoScenes",
        dict.fromkeys(
            [
                *("buildingA_spring", "buildingA_winter", "double_robot", "exhibition_building", "freezing_ice_cup"),
                *("heater_water_cup", "heater_water_kettle", "melting_ice_cup", "raspberrypi", "trees"),
            ]
        ),
        _thermoscenes_lack,
    ),
}
"""By the word that stands for it on the command line. Counts: the project page of ThermalGaussian (arXiv 2409.07200).
The ten scenes of ThermoScenes are those of ThermoNeRF's first edition (arXiv 2403.12154v1)."""


def expand_collections(words: Iterable[str]) -> tuple[list[str], list[str]]:
    """Write ``rgbt-scenes=FOLDER`` and ``thermoscenes=FOLDER`` out as the scenes in that folder.

    Returns:
        The words as ``parse_scenes`` takes them, and sentences on what the folders lack.

    Raises:
        UserError: A collection's folder has none of its scenes, or a scene that is not whole.
    """
    expanded: list[str] = []
    notes: list[str] = []
    for word in words:
        name, _, folder = word.partition("=")
        if name not in COLLECTIONS or Path(data_from_anywhere(word)).is_dir():
            expanded.append(word)
            continue
        collection, root = COLLECTIONS[name], Path(data_from_anywhere(folder or name))
        found = _found(collection, root, name)
        expanded += [f"{scene}={path}" for scene, path in found.items()]
        missing = [scene for scene in collection.scenes if scene not in found]
        if missing:
            notes.append(
                f"{root} has {len(found)} of the {len(collection.scenes)} scenes of {collection.title}. Missing: "
                f"{', '.join(missing)}. Without them the published means cannot stand beside ours."
            )
        notes += _counts(collection, found)
    return expanded, notes


def plain_name(name: str) -> str:
    """A scene's name without capitals, spaces and underscores, which copies of a collection write differently."""
    return "".join(letter for letter in name.lower() if letter.isalnum())


def _found(collection: Collection, root: Path, name: str) -> dict[str, Path]:
    """Folders of the collection's scenes by the published name, each whole."""
    if not root.is_dir():
        raise UserError(f"There is no folder {root}.", f"Give the folder of all scenes: {name}=FOLDER.")
    folders = {plain_name(path.name): path for path in sorted(root.iterdir()) if path.is_dir()}
    found = {scene: folders[plain_name(scene)] for scene in collection.scenes if plain_name(scene) in folders}
    if not found:
        raise UserError(
            f"{root} has none of the scenes of {collection.title}. Expected folders: {', '.join(collection.scenes)}.",
            "Give the folder that holds them. Other captures are given one by one: thermosplat-benchmark CAPTURE ...",
        )
    broken = [f"{path} lacks {', '.join(lacks)}" for path in found.values() if (lacks := collection.lacking(path))]
    if broken:
        raise UserError(
            "; ".join(broken) + ".", f"Download {collection.title} again, or take that folder out of {root}."
        )
    return found


def _counts(collection: Collection, found: Mapping[str, Path]) -> list[str]:
    """Sentences on scenes that have more or fewer pictures than were published."""
    notes = []
    for scene, path in found.items():
        published = collection.scenes[scene]
        if published is None:
            continue
        here = tuple(_pictures(path / "rgb" / part) for part in ("train", "test"))
        if here != published:
            notes.append(
                f"{path} has {here[0]} training and {here[1]} test photographs. Published: {published[0]} and "
                f"{published[1]}. Its numbers do not compare with published ones."
            )
    return notes


def _pictures(folder: Path) -> int:
    return sum(path.suffix.lower() in _PICTURES for path in folder.iterdir())
