"""The subcommands of thermosplat-prepare that deal with files: import, pair, check."""

import dataclasses
import os
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from thermosplat.cli.command_line import check_ranges
from thermosplat.cli.host_settings import WITHOUT_TORCH, importing
from thermosplat.cli.preparing.steps import CaptureArguments, capture_at, say, say_next
from thermosplat.errors import UserError
from thermosplat.printing import printable


@dataclass(frozen=True)
class SourceArguments:
    """Which files a capture is made of, and where it is written."""

    folder: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")] = ""
    """Folder with the photographs and the thermal files, at any depth."""
    out: str = ""
    """Folder of the capture. None: captures/<name of FOLDER>."""
    rgb: str | None = None
    """Folder of the photographs. None: they are found by names, sizes and what the files hold."""
    thermal: str | None = None
    """Folder of the thermal files. None: they are found likewise. With FOLDER in place of --rgb, they are of another
    hour than its photographs, and are not paired."""
    further: tuple[str, ...] = ()
    """Folders of further spectra, such as nir=data/shed/nir."""
    unit: str | None = None
    """Unit of 16-bit and floating-point thermal values after --scale and --offset: kelvin, decikelvin, centikelvin,
    celsius, fahrenheit and others, or counts for none. None: units.json beside the files, else judged by the values."""
    scale: float | None = None
    """What thermal values are multiplied by to be in that unit."""
    offset: float | None = None
    """What is added then."""
    range: tuple[float, float] | None = None
    """Temperatures [°C] of the palette's ends, for thermal pictures without values."""
    palette: str | None = None
    """Palette of such pictures: iron, grey, or a file. None: the one in the files, else FLIR Iron."""
    keep_color: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Leave pseudo-coloured pictures as they are."""
    turn: Literal[0, 90, 180, 270] = 0
    """Degrees by which thermal images are turned clockwise, for a sensor that is built in that way."""
    mirror: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Mirror thermal images, left and right."""
    every: int = 15
    """Of a video, every so many frames are taken."""
    take_most: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """If the images of a spectrum come from several cameras or sizes, take the most frequent."""
    skip_unreadable: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Leave out images that cannot be read, and thermal files of which no temperatures can be had."""
    turn_back: Literal[90, 270] | None = None
    """Images whose sides are swapped against the others', which a program has turned, are turned clockwise by so many
    degrees. None: they are refused."""

    @property
    def of_another_hour(self) -> bool:
        """Whether thermal images have no photographs of their moments."""
        return bool(self.folder and self.thermal and not self.rgb)

    @property
    def capture_folder(self) -> str:
        """Where the capture is written.

        Raises:
            UserError: No folder was named.
        """
        if self.out:
            return self.out
        place = self.folder or self.rgb
        if not place:
            raise UserError("No folder given.", "Say where the files are: thermosplat-prepare FOLDER")
        name = Path(os.path.abspath(os.path.expanduser(place))).name
        return str(Path("captures") / printable(name))

    def folders(self) -> dict[str, str]:
        """Folder of each spectrum that was named.

        Raises:
            UserError: A further spectrum is not written as NAME=DIR, or thermal files are named without photographs.
        """
        named = {"rgb": self.folder if self.of_another_hour else self.rgb, "thermal": self.thermal}
        for words in self.further:
            name, sign, place = words.partition("=")
            if not (sign and name and place) or name in named:
                raise UserError(f"--further {words} is not NAME=DIR.", "For example: --further nir=data/shed/nir")
            named[name] = place
        found = {name: os.path.expanduser(place) for name, place in named.items() if place}
        if found and "rgb" not in found:
            raise UserError("The folder of the photographs is missing.", "Name it, too: --rgb DIR")
        return found


@dataclass(frozen=True)
class ImportArguments(SourceArguments):
    """Find photographs and thermal files, and turn thermal files into values with a unit."""

    debug: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class PairArguments(CaptureArguments):
    """Find which thermal image was taken with which photograph."""

    by: Literal["auto", "name", "number", "time", "order", "none"] = "auto"
    """How images are paired: names that agree but for the camera, the last number in the names, the time with a
    constant difference between the clocks, or the order of the names. auto: the first that pairs nearly all. none:
    thermal images are of another hour, and find their own places."""


@dataclass(frozen=True)
class CheckArguments(CaptureArguments):
    """Say what the capture has and what may go wrong, and make a page to look at."""


def run_import(arguments: ImportArguments) -> int:
    """``thermosplat-prepare import``; returns the exit code."""
    root = Path(arguments.capture_folder)
    import_source(arguments, root)
    say_next("prepare pair", capture_at(root))
    return 0


def import_source(arguments: SourceArguments, root: Path) -> None:
    """Import what the arguments name into a capture's folder, and say what was found."""
    with importing(WITHOUT_TORCH):
        from thermosplat.prepare.importing.import_files import import_files
        from thermosplat.prepare.importing.import_options import ImportOptions
        from thermosplat.prepare.importing.thermal_images import ThermalOptions

    numbers = dict.fromkeys(("scale", "offset", "range"), (-1e30, 1e30))
    check_ranges(arguments, every=(1, 1_000_000_000), **numbers)
    shared = {field.name: getattr(arguments, field.name) for field in dataclasses.fields(ThermalOptions)}
    options = ImportOptions(
        folders=arguments.folders(),
        every=arguments.every,
        take_most=arguments.take_most,
        skip_unreadable=arguments.skip_unreadable,
        turn_back=arguments.turn_back,
        thermal=ThermalOptions(**shared),
    )
    folder = Path(os.path.expanduser(arguments.folder)) if arguments.folder else None
    say("import", import_files(folder, capture_at(root), options))


def run_pair(arguments: PairArguments) -> int:
    """``thermosplat-prepare pair``; returns the exit code."""
    with importing(WITHOUT_TORCH):
        from thermosplat.prepare.pairing.pairing import pair_frames

    capture = capture_at(arguments.capture)
    say("pair", pair_frames(capture, arguments.by))
    say_next("prepare sfm", capture)
    return 0


def run_check(arguments: CheckArguments) -> int:
    """``thermosplat-prepare check``; returns the exit code."""
    with importing(WITHOUT_TORCH):
        from thermosplat.prepare.checking.check import check, is_posed

    capture = capture_at(arguments.capture)
    say("check", check(capture))
    if (capture.check / "index.html").is_file():  # nothing is written into a capture of another program
        print(f"Look at {shlex.quote(str(capture.check / 'index.html'))}")
    say_next("train" if is_posed(capture.root) else "prepare sfm", capture)
    return 0
