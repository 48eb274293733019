"""Programs that convert the counts in DJI's radiometric JPEGs, which a user installs.

DJI's Thermal SDK has the program ``dji_irp``; ``dji-thermal-cli`` is a free one. Both are run as programs of their own
and never linked: DJI's licence and the AGPL say what may be done with them. Either one is told, or takes by itself, the
distance, emissivity and air that the file states, so that both give the same temperatures.

Sources of the calls: the help of ``dji_irp`` ("-s IMAGE -a measure --measurefmt float32 -o FILE" writes °C, row by
row), and the help of dji-thermal-cli 1.4.0 ("process" writes <stem>_temp_c.tiff of float32 °C, -273.15 where there is
none; "--distance embedded" keeps the file's distance, without which a laser's reading is taken).
"""

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.images.image_files import read_image
from thermosplat.errors import UserError
from thermosplat.prepare.importing.dji_files import DjiFile
from thermosplat.prepare.progress import tracked

IRP, CLI = PROGRAMS = ("dji_irp", "dji-thermal-cli")
"""Programs that can convert the counts, the first one preferred."""
INSTALL = (
    "Install one: pipx install dji-thermal-cli, or the DJI Thermal SDK (dji.com/downloads/softwares/dji-thermal-sdk; "
    "put dji_irp on the PATH)."
)
_TIMEOUT, _TIMEOUT_PER_FILE = 120, 40
"""Seconds after which a program is taken for hanging; the slowest of 62 files took 35."""
_LEAST_CELSIUS = -150.0
"""Below it [°C] a pixel has no temperature: dji-thermal-cli writes -273.15, DJI's own floor is about that."""


@dataclass
class Conversion:
    """What programs made of files with counts.

    Args:
        outputs: What was written for each file: raw floats or a TIFF.
        failures: Why a program could not convert a file, by the file.
    """

    outputs: dict[Path, Path] = field(default_factory=dict)
    programs: dict[Path, str] = field(default_factory=dict)
    failures: dict[Path, str] = field(default_factory=dict)

    def celsius(self, file: DjiFile) -> NDArray[np.float32]:
        """Temperatures of a file [°C], [H, W]; NaN where the program found none.

        Raises:
            UserError: No program could convert it, or what it wrote are no temperatures of this file.
        """
        if file.path not in self.outputs:
            raise _failed(file.path, self.failures.get(file.path, "it was not converted"))
        output, program = self.outputs[file.path], self.programs[file.path]
        if output.suffix == ".raw":
            values = np.fromfile(output, "<f4")
            if values.size != file.stored.size:
                size = f"{file.stored.shape[1]}x{file.stored.shape[0]} px"
                raise _failed(file.path, f"{program} wrote {values.size:,} values for a sensor of {size}")
            values = values.reshape(file.stored.shape)
        else:
            values = read_image(output)
        if values.ndim != 2 or values.dtype.kind != "f" or not (values > _LEAST_CELSIUS).any():
            raise _failed(file.path, f"what {program} wrote are no temperatures")
        celsius = np.where(values > _LEAST_CELSIUS, values, np.nan).astype(np.float32)
        file.check_picture(celsius)
        return celsius


def installed() -> dict[str, str]:
    """The path of each program that is installed, by its name."""
    return {name: found for name in PROGRAMS if (found := shutil.which(name))}


@contextmanager
def converted(paths: Sequence[Path]) -> Iterator[Conversion]:
    """Convert files with the programs that are installed; what they write is there until the end.

    The first program takes all files, the second one those with which the first has failed.

    Args:
        paths: Radiometric JPEGs with counts. Programs say for themselves which they can read.
    """
    done = Conversion()
    with tempfile.TemporaryDirectory() as folder:
        for name, program in installed().items():
            left = [path for path in paths if path not in done.outputs]
            if left:
                (_with_irp if name == IRP else _with_cli)(program, left, Path(folder), done)
        yield done


def _with_irp(program: str, paths: Sequence[Path], folder: Path, done: Conversion) -> None:
    for number, path in enumerate(tracked(paths, f"converting with {IRP}", len(paths))):
        output = folder / f"{number:06d}.raw"
        words = [program, "-s", str(path), "-a", "measure", "--measurefmt", "float32", "-o", str(output)]
        code, lines = _run(words, _TIMEOUT)
        if code == 0 and output.is_file():
            done.outputs[path], done.programs[path] = output, IRP
        else:
            done.failures[path] = _reason(IRP, code, lines)


def _with_cli(program: str, paths: Sequence[Path], folder: Path, done: Conversion) -> None:
    """All files in one call, because the program takes seconds to start."""
    inputs, outputs = folder / "in", folder / "out"
    inputs.mkdir()
    names = [f"{number:06d}.jpg" for number in range(len(paths))]
    for path, name in zip(paths, names):
        try:
            os.link(path.resolve(), inputs / name)
        except OSError:  # another file system, or one without links
            shutil.copyfile(path, inputs / name)
    words = [program, "process", "--input-dir", str(inputs), "--output-dir", str(outputs), "-o", "temp_c:tiff"]
    code, lines = _run([*words, "--distance", "embedded"], _TIMEOUT + _TIMEOUT_PER_FILE * len(paths))
    for path, name in zip(paths, names):
        written = sorted(outputs.rglob(f"{Path(name).stem}_*.tif*"))
        if len(written) == 1:
            done.outputs[path], done.programs[path] = written[0], CLI
        else:
            mine = [line.replace(f"{inputs}{os.sep}", "").replace(name, path.name) for line in lines if name in line]
            earlier = f"{done.failures[path]}; " if path in done.failures else ""
            done.failures[path] = earlier + _reason(CLI, code, mine or lines)


def _run(words: list[str], seconds: float) -> tuple[int | None, list[str]]:
    """The exit code and what was printed; None where the program could not be started, or did not end."""
    libraries = [str(Path(words[0]).resolve().parent), *filter(None, [os.environ.get("LD_LIBRARY_PATH")])]
    environment = {**os.environ, "LD_LIBRARY_PATH": os.pathsep.join(libraries)}  # dji_irp's lie beside it
    try:
        done = subprocess.run(
            words,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=seconds,
            check=False,
            env=environment,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return None, [str(error)]
    return done.returncode, [line for line in (*done.stderr.splitlines(), *done.stdout.splitlines()) if line.strip()]


def _reason(program: str, code: int | None, lines: Sequence[str]) -> str:
    """Why a program failed: what it calls an error, else the last thing that it said."""
    errors = [line for line in lines if "error" in line.lower()]
    said = (errors or list(lines[-1:]) or ["it said nothing"])[0].strip().rstrip(".")
    return f"{program}: {f'exit code {code}: ' if code else ''}{said}"


def _failed(path: Path, reason: str) -> UserError:
    return UserError(
        f"The counts in {path} cannot be converted: {reason}.",
        "Is it an untouched file of a supported camera? Export 16-bit TIFFs and give their folder, --thermal DIR, or "
        "leave the file out: --skip-unreadable",
    )
