"""The files of a prepared capture: what lies where, and its two tables.

    CAPTURE/
      images/rgb/<name>.jpg        photographs as the camera wrote them
      images/thermal/<name>.png    16-bit values; units.json beside them names their unit
      frames.csv                   one row per image: where it comes from, its size, time, place and camera
      thermal_parameters.json      emissivity, distance and the like of each thermal file that states them
      pairs.csv                    which thermal image was taken with which photograph
      calibration.json             lenses and the pose between the cameras, where a board was seen
      sparse/0/                    the COLMAP model: the photographs, then the thermal camera as part of a rig
      geo.json                     where the model lies on the Earth, if GPS says so
      train.yaml                   settings that ``thermosplat-train CAPTURE`` starts from
      check/                       a contact sheet and a page to look at
      prepared/<step>.json         one file per finished step

Image names in both tables are relative to ``images/<spectrum>/``. In the COLMAP model they are relative to ``images/``.
"""

import csv
import io
from collections.abc import Sequence
from dataclasses import Field, dataclass, fields
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar, get_args

from thermosplat.datasets.geo_file import GEO_FILE
from thermosplat.errors import UserError
from thermosplat.regular_files import read_regular
from thermosplat.runs.atomic_writes import write_bytes

LEADING = "rgb"
"""The spectrum of the photographs, from which structure from motion finds poses."""
OTHER = "thermal"
"""The spectrum that is paired with them where nothing else is said."""


@dataclass(frozen=True, kw_only=True)
class Exif:
    """What a file says of its exposure; None (an empty field) for what it does not say.

    Args:
        time: When it was taken, ISO 8601 with subseconds; without a zone where the file has none.
        latitude: [°], north positive.
        longitude: [°], east positive.
        altitude: [m] above sea level.
        relative_altitude: [m] above the place of take-off.
        position_std: Standard deviation of the position [m] as an RTK receiver states it, the larger of east and north.
        altitude_std: The same of the altitude [m].
        rtk_flag: What DJI says of the receiver: 0 no fix, 16 GPS alone, 34 RTK to decimetres, 50 to centimetres.
        gimbal_yaw: Where the camera looked [°], clockwise from north.
        gimbal_pitch: The same [°], -90 straight down.
        gimbal_roll: The same [°].
        focal_length_mm: Focal length [mm].
        focal_length_35mm: The focal length [mm] with the same field of view on 36x24 mm film.
        orientation: 1 to 8, how the stored pixels are turned for display.
        iso: Sensitivity of the exposure, which only photographs have.
        digital_zoom: How far the picture was enlarged.
    """

    time: str | None = None
    latitude: float | None = None
    longitude: float | None = None
    altitude: float | None = None
    relative_altitude: float | None = None
    position_std: float | None = None
    altitude_std: float | None = None
    rtk_flag: int | None = None
    gimbal_yaw: float | None = None
    gimbal_pitch: float | None = None
    gimbal_roll: float | None = None
    focal_length_mm: float | None = None
    focal_length_35mm: float | None = None
    make: str | None = None
    model: str | None = None
    orientation: int | None = None
    iso: float | None = None
    digital_zoom: float | None = None


@dataclass(frozen=True)
class FrameRow(Exif):
    """One image of the capture: a row of frames.csv, which ends with what the file says of its exposure.

    Args:
        spectrum: Name of its spectrum, which is its folder below ``images/``.
        file: Its path below that folder.
        source: The file it was made from, relative to the imported folder; ``video.mp4#120`` for a frame of a video.
        width: Width [px] of the pixels as stored; EXIF rotation is not applied.
        height: Height [px].
    """

    spectrum: str
    file: str
    source: str
    width: int
    height: int


@dataclass(frozen=True)
class PairRow:
    """Two images of one exposure: a row of pairs.csv; paths below images/rgb/ and images/thermal/."""

    rgb: str
    thermal: str


Row = TypeVar("Row", FrameRow, PairRow)


@dataclass(frozen=True)
class CaptureFolder:
    """A capture that is being prepared.

    Args:
        root: Its folder, which need not exist yet.
    """

    root: Path

    def images(self, spectrum: str) -> Path:
        """Folder with the images of a spectrum."""
        return self.root / "images" / spectrum

    @property
    def units_json(self) -> Path:
        """What the values of the thermal images mean."""
        return self.images(OTHER) / "units.json"

    @property
    def thermal_parameters(self) -> Path:
        """What each thermal file says of its object, air and camera (``thermal.thermal_parameters``)."""
        return self.root / "thermal_parameters.json"

    @property
    def frames_csv(self) -> Path:
        """The table of images."""
        return self.root / "frames.csv"

    @property
    def pairs_csv(self) -> Path:
        """The table of pairs."""
        return self.root / "pairs.csv"

    @property
    def calibration_json(self) -> Path:
        """Lenses and the pose between the cameras, as ``calibrate`` found them."""
        return self.root / "calibration.json"

    @property
    def sparse(self) -> Path:
        """Folder of the COLMAP model."""
        return self.root / "sparse" / "0"

    @property
    def geo_json(self) -> Path:
        """Where the model lies on the Earth."""
        return self.root / GEO_FILE

    @property
    def train_yaml(self) -> Path:
        """Settings that training starts from, as ``prepare`` recommends them."""
        return self.root / "train.yaml"

    @property
    def check(self) -> Path:
        """Folder of the contact sheet and the page."""
        return self.root / "check"

    @property
    def prepared(self) -> Path:
        """Folder of the files that say which steps are complete."""
        return self.root / "prepared"

    def marker(self, step: str) -> Path:
        """The file that says that a step is complete."""
        return self.prepared / f"{step}.json"

    def read_frames(self, spectrum: str | None = None) -> list[FrameRow]:
        """The images, of one spectrum or of all.

        Raises:
            UserError: frames.csv is missing or damaged.
        """
        hint = "Import the images first: thermosplat-prepare import FOLDER --out CAPTURE"
        rows = _read(self.frames_csv, FrameRow, hint)
        return [row for row in rows if spectrum in (None, row.spectrum)]

    def write_frames(self, rows: Sequence[FrameRow]) -> None:
        """Replace frames.csv."""
        _write(self.frames_csv, rows, FrameRow)

    def read_pairs(self) -> list[PairRow]:
        """The pairs.

        Raises:
            UserError: pairs.csv is missing or damaged.
        """
        return _read(self.pairs_csv, PairRow, f"Pair the images first: thermosplat-prepare pair {self.root}")

    def write_pairs(self, rows: Sequence[PairRow]) -> None:
        """Replace pairs.csv."""
        _write(self.pairs_csv, rows, PairRow)


def _read(path: Path, kind: type[Row], hint: str) -> list[Row]:
    try:
        text = read_regular(path).decode("utf-8-sig")
    except FileNotFoundError as error:
        raise UserError(f"There is no {path.name} in {path.parent}.", hint) from error
    except (OSError, ValueError) as error:
        raise UserError(f"Cannot read {path}: {getattr(error, 'strerror', None) or error}.", hint) from error
    rows = []
    reader = csv.DictReader(io.StringIO(text))
    for record in reader:
        try:
            rows.append(_row(record, kind))
        except (KeyError, TypeError, ValueError) as error:
            columns = ", ".join(field.name for field in _columns(kind))
            raise UserError(
                f"Line {reader.line_num} of {path} is damaged; the columns are {columns}.", f"Correct it. Or: {hint}"
            ) from error
    return rows


def _row(record: dict[str, str | None], kind: type[Row]) -> Row:
    values: dict[str, object] = {}
    for field in _columns(kind):
        text = (record.get(field.name) or "").strip()
        if text:
            kinds = get_args(field.type) or (field.type,)
            values[field.name] = next(number for number in (int, float, str) if number in kinds)(text)
    for name in ("file", "rgb", "thermal"):
        path = PurePosixPath(str(values.get(name, "")))
        if path.is_absolute() or ".." in path.parts:
            raise ValueError(f"{path} leads out of the capture")
    return kind(**values)  # type: ignore[arg-type]


def _columns(kind: type[Row]) -> list[Field[Any]]:
    """The columns of a table: first what every row has, then what a file may say."""
    return sorted(fields(kind), key=lambda field: field.kw_only is True)


def _write(path: Path, rows: Sequence[Row], kind: type[Row]) -> None:
    names = [field.name for field in _columns(kind)]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    writer.writerows([["" if (value := getattr(row, name)) is None else value for name in names] for row in rows])
    write_bytes(path, text.getvalue().encode())
