"""Files of thermal cameras that are not read here: whose format each is, and what to export instead."""

from collections.abc import Sequence
from pathlib import Path

from thermosplat.prepare.counted import agreeing, counted

_MAKERS: dict[str, tuple[str, ...]] = {
    "FLIR's raw files and sequences: FLIR Thermal Studio or Research Studio exports them": (
        *(".seq", ".csq", ".fff", ".fcf", ".ats", ".ptw", ".sfmov"),
    ),
    "Fluke's: SmartView or Fluke Connect exports them": (".is2", ".is3"),
    "Testo's: IRSoft exports them": (".bmt", ".vmt"),
    "InfraTec's: IRBIS exports them": (".irb",),
    "InfiRay's: the camera's own program exports them": (".irg",),
    "Optris's: PIX Connect exports them": (".ravi",),
    "Workswell's sequences: CorePlayer or ThermoFormat exports them": (".wseq",),
}
_OF_SUFFIX = {suffix: maker for maker, suffixes in _MAKERS.items() for suffix in suffixes}


def foreign_sentences(paths: Sequence[Path], root: Path) -> list[str]:
    """A sentence for each maker whose thermal files lie in a folder and cannot be read.

    Args:
        root: The folder that names in the sentences are relative to.
    """
    found: dict[str, list[Path]] = {}
    for path in sorted(paths):
        if (maker := _OF_SUFFIX.get(path.suffix.lower())) is not None:
            found.setdefault(maker, []).append(path)
    return [
        f"{counted(len(mine), 'thermal file')} {agreeing(len(mine), 'was', 'were')} not read (first: "
        f"{mine[0].relative_to(root).as_posix()}). This format is {maker} as radiometric JPEGs or 16-bit TIFFs."
        for maker, mine in found.items()
    ]
