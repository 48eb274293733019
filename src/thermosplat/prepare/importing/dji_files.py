"""DJI's radiometric JPEGs (R-JPEG), through a program that the user installs.

Their format is not published. DJI's Thermal SDK has the program ``dji_irp``; ``dji-thermal-cli`` is a free one. Both
are run as programs of their own and never linked: DJI's licence and the AGPL say what may be done with them.

Sources of the calls: the help of ``dji_irp`` ("-s IMAGE -a measure --measurefmt float32 -o FILE" writes °C, row by row)
and the README of dji-thermal-cli 1.4.0 ("process --input-dir --output-dir -o temp_c:tiff" writes <stem>_temp_c.tiff of
float32 °C, -273.15 where there is none). Neither was run here on a file of DJI's.
"""

import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.images.image_files import read_image
from thermosplat.errors import UserError

PROGRAMS = ("dji_irp", "dji-thermal-cli")
"""Programs that can read the files, the first one preferred."""
_TIMEOUT = 120
"""Seconds after which a program that reads one image is taken for hanging."""
_LEAST_CELSIUS = -150.0
"""Below it [°C] a pixel has no temperature: dji-thermal-cli writes -273.15, DJI's own floor is about that."""


def is_dji_thermal(content: bytes, make: str | None) -> bool:
    """Whether a JPEG is DJI's with radiometric data, which lies in segments APP3 (ExifTool, DJI.pm)."""
    if make is None or not make.upper().startswith("DJI"):
        return False
    at = 2
    while at + 4 <= len(content) and content[at] == 0xFF and content[at + 1] != 0xDA:
        if content[at + 1] == 0xE3:
            return True
        at += 2 + int.from_bytes(content[at + 2 : at + 4], "big")
    return False


def require_dji_program() -> str:
    """The path of a program that reads R-JPEGs.

    Raises:
        UserError: None is installed.
    """
    for program in PROGRAMS:
        if found := shutil.which(program):
            return found
    raise UserError(
        "Temperatures in DJI's radiometric JPEGs can be read by DJI's own program or by dji-thermal-cli, and neither "
        f"{' nor '.join(PROGRAMS)} is on the PATH.",
        "Install one: the DJI Thermal SDK (dji.com/downloads/softwares/dji-thermal-sdk, put dji_irp on the PATH), "
        "or pipx install dji-thermal-cli. Or export 16-bit TIFFs and give their folder: --thermal DIR",
    )


def read_dji(path: Path, width: int, height: int) -> NDArray[np.float32]:
    """Temperatures of an R-JPEG.

    Args:
        path: The file.
        width: Of the picture that is seen [px].
        height: The same [px].

    Returns:
        [H, W] [°C], at the sensor's size; NaN where the program found no temperature.

    Raises:
        UserError: No program is installed, or it cannot read the file.
    """
    program = require_dji_program()
    with tempfile.TemporaryDirectory() as folder:
        if Path(program).name == PROGRAMS[0]:
            output = Path(folder) / "measured.raw"
            _run([program, "-s", str(path), "-a", "measure", "--measurefmt", "float32", "-o", str(output)], path)
            celsius = _in_rows(path, output, width, height)
        else:
            inputs, outputs = Path(folder) / "in", Path(folder) / "out"
            inputs.mkdir()
            shutil.copyfile(path, inputs / f"image{path.suffix}")
            words = ["process", "--input-dir", str(inputs), "--output-dir", str(outputs), "-o", "temp_c:tiff"]
            _run([program, *words], path)
            written = sorted(outputs.rglob("image*.tif*"))
            if len(written) != 1:
                raise _failed(program, path, f"it wrote {len(written)} TIFF files")
            celsius = read_image(written[0])
    if celsius.ndim != 2 or celsius.dtype.kind != "f" or not (celsius > _LEAST_CELSIUS).any():
        raise _failed(program, path, "what it wrote are no temperatures")
    return np.where(celsius > _LEAST_CELSIUS, celsius, np.nan).astype(np.float32)


def _run(words: list[str], path: Path) -> None:
    libraries = [str(Path(words[0]).resolve().parent), *filter(None, [os.environ.get("LD_LIBRARY_PATH")])]
    environment = {**os.environ, "LD_LIBRARY_PATH": os.pathsep.join(libraries)}  # dji_irp's lie beside it
    try:
        done = subprocess.run(
            words,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_TIMEOUT,
            check=False,
            env=environment,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise _failed(words[0], path, str(error)) from error
    if done.returncode:
        said = (done.stderr.strip() or done.stdout.strip() or "it said nothing").splitlines()[-1]
        raise _failed(words[0], path, f"exit code {done.returncode}: {said}")


def _in_rows(path: Path, output: Path, width: int, height: int) -> NDArray[Any]:
    """Values in a file without a header; the sensor has the picture's aspect, and perhaps fewer pixels."""
    try:
        values = np.fromfile(output, "<f4")
    except OSError as error:
        raise _failed(PROGRAMS[0], path, "it wrote nothing") from error
    for factor in (1, 2, 3, 4):
        if values.size and values.size * factor * factor == width * height:
            return values.reshape(height // factor, width // factor)
    raise _failed(PROGRAMS[0], path, f"it wrote {values.size:,} values for a picture of {width}x{height} px")


def _failed(program: str, path: Path, reason: str) -> UserError:
    return UserError(
        f"{Path(program).name} cannot read {path}: {reason}.",
        "Is it an untouched file of a supported camera? Or export 16-bit TIFFs and give their folder: --thermal DIR",
    )
