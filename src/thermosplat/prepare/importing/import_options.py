"""What the user says about the files that a capture is made of."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from thermosplat.prepare.importing.thermal_images import ThermalOptions


@dataclass(frozen=True)
class ImportOptions:
    """What the user says about the files.

    Args:
        folders: Folder of each spectrum that is not to be found by itself.
        every: Of a video every so many frames are taken.
        take_most: Of several cameras or sizes in one spectrum take the most frequent.
        skip_unreadable: Leave out files that cannot be read.
        turn_back: Degrees by which images whose sides are swapped against the others' are turned clockwise; None: such
            images are refused.
    """

    folders: Mapping[str, str] = field(default_factory=dict)
    every: int = 15
    take_most: bool = False
    skip_unreadable: bool = False
    turn_back: Literal[90, 270] | None = None
    thermal: ThermalOptions = field(default_factory=ThermalOptions)

    def settings(self) -> dict[str, Any]:
        """As plain values, for the step's file."""
        return {
            "folders": dict(self.folders),
            "every": self.every,
            "take_most": self.take_most,
            "skip_unreadable": self.skip_unreadable,
            "turn_back": self.turn_back,
            "thermal": self.thermal.settings(),
        }
