"""Render one of the captures again, or score images in degrees against a capture's.

    cd benchmarks; pip install "thermosplat[render]"
    python -m rendered_captures desk --out data/desk
    python -m rendered_captures flight_b --out data/flight_b --variant cuda_ad_rgb
    python -m rendered_captures score results/desk data/desk

Without further flags it is the published capture: poses, labels and temperatures are the same, images within noise.
"""

import argparse
import sys
from pathlib import Path

from thermosplat.errors import UserError

_PAIRED = ("desk", "lab", "yard")
_FLIGHTS = ("flight_a", "flight_b", "flight_c")


def main(arguments: list[str] | None = None) -> int:
    """Run the command; the exit code is 2 where the user has to do something."""
    options = _parsed(sys.argv[1:] if arguments is None else arguments)
    try:
        if options.what == "score":
            from rendered_captures.score import score

            print(score(options.images, options.capture))
        else:
            _render(options)
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def _parsed(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="rendered_captures", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="what", required=True)
    for name in (*_PAIRED, "rig_desk", *_FLIGHTS):
        command = commands.add_parser(name, help=f"render {name}")
        command.add_argument("--out", type=Path, required=True, help="folder of the capture; it must not hold files")
        command.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba's: llvm_ad_rgb (CPU), cuda_ad_rgb (GPU)")
        command.add_argument("--views", type=int, help="photographs, of flights about so many")
        command.add_argument("--samples", type=int, help="per pixel; few of them are fast and noisy")
        command.add_argument("--seed", type=int, help="of scene, path and noise")
        command.add_argument("--drift", type=float, help="span of the thermal camera's level over all frames [K]")
        command.add_argument("--jump-every", type=int, help="frames between two closings of its shutter; 0: never")
        command.add_argument("--electrons", type=float, help="at white of photographs in the dark, such as 140")
        if name in _PAIRED:
            command.add_argument("--size", help="WIDTHxHEIGHT of both images (400x300)")
        else:
            command.add_argument("--size-factor", type=float, default=1.0, help="of both images' width and height")
            command.add_argument("--unpaired", action="store_true", help="take thermal images between photographs")
            command.add_argument(
                "--readout", type=float, default=0.0, help="of a thermal image, as a share of the time between frames"
            )
    command = commands.add_parser("score", help="errors of images in degrees, by region")
    command.add_argument("images", type=Path, help="a run of thermosplat, or a folder of images in deg C")
    command.add_argument("capture", type=Path, help="the capture that was rendered")
    return parser.parse_args(arguments)


def _render(options: argparse.Namespace) -> None:
    if options.out.exists() and (not options.out.is_dir() or any(options.out.iterdir())):
        raise UserError(f"{options.out} holds something already.", "--out a folder that is new")
    for name in ("views", "samples", "electrons"):
        if getattr(options, name) is not None and getattr(options, name) <= 0:
            raise UserError(f"--{name} must be more than 0.")
    size = _size(options.size) if getattr(options, "size", None) is not None else None
    from rendered_captures.rendering.start import start

    start(options.variant)
    common = {"seed": options.seed, "views": options.views, "drift": options.drift, "jump_every": options.jump_every}
    common = {name: value for name, value in common.items() if value is not None}
    common.update(samples=options.samples, electrons=options.electrons)
    options.out.mkdir(parents=True, exist_ok=True)
    if options.what in _PAIRED:
        from rendered_captures.files.paired import Paired, write_paired

        if size is not None:
            common.update(width=size[0], height=size[1])
        write_paired(Paired(options.what, **common), options.out)
    else:
        from rendered_captures.files.mount import Variant

        own = {"size_factor": options.size_factor, "unpaired": options.unpaired, "readout": options.readout}
        variant = Variant(**common, **own)
        if options.what == "rig_desk":
            from rendered_captures.files.rig import write_rig

            write_rig(variant, options.out)
        else:
            from rendered_captures.files.flight import write_flight

            write_flight(_FLIGHTS.index(options.what), variant, options.out)
    (options.out / "LICENSE.txt").write_text((Path(__file__).parent / "LICENSE.txt").read_text())


def _size(text: str) -> tuple[int, int]:
    sides = text.lower().split("x")
    if len(sides) != 2 or not all(side.isdecimal() and int(side) > 0 for side in sides):
        raise UserError(f"--size {text!r} is no size.", "--size 400x300")
    return int(sides[0]), int(sides[1])


if __name__ == "__main__":
    sys.exit(main())
