"""What a spectrum is: where its images come from, how the Gaussians hold it, and what its losses weigh.

A model has a list of spectra. ``DEFAULT_SPECTRA`` is the list of ThermoSplat, RGB and thermal infrared. A YAML file
adds others in a few lines (docs/spectra.md). Nothing in the package asks for a spectrum by its name.

This file imports nothing heavy, so that ``thermosplat-train --help`` answers at once.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

Source = Literal["photograph", "auto", "color", "raw", "labels", "features", "bands"]
Opacity = Literal["shared", "offset", "own"]
Exposure = Literal["fixed", "level", "affine"]
ColorSpace = Literal["photograph", "color", "scalar", "labels", "stack"]

STACKS = ("features", "bands")
"""Sources whose files have any number of channels."""
LATENT = 16
"""Channels of the basis in which stacks are learnt. Open choice: Efficient Feature 3DGS and HyperGS have 16 to 64."""
CELSIUS = "celsius"
"""The unit in which temperatures are kept and reported."""
TEMPERATURE_UNITS = (
    *("kelvin", "decikelvin", "centikelvin", "millikelvin"),
    *(CELSIUS, "decicelsius", "centicelsius", "fahrenheit"),
)
"""Units of radiometric files that are turned into °C."""
BUILT_IN_PALETTES = ("grey", "iron")
"""Names of palettes that need no file."""
MAE = "mae_"
"""Begin of the name of a mean absolute error of measured values; the unit follows: mae_celsius."""
BIAS = "bias_"
"""The same of the mean of rendered minus measured values: bias_celsius."""
COUNTS = "counts"
"""The unit of raw sensor values: none."""
_SPELLINGS = {
    **{"k": "kelvin", "dk": "decikelvin", "ck": "centikelvin", "mk": "millikelvin"},
    **{"c": CELSIUS, "centigrade": CELSIUS, "f": "fahrenheit"},
    **{"count": COUNTS, "dn": COUNTS, "adu": COUNTS, "rawcounts": COUNTS, "digitalnumber": COUNTS},
}
"""Other words for units, without case, signs, "degrees" and a plural's s."""

NOISY_SENSOR = 0.0125
"""Noise of images (standard deviation, of the range 0 to 1, Immerkaer 1996 with stripes) from which on their sensor is
a noisy one: arco's thermal images have 0.0140, desk's 0.0012. Open choice."""


@dataclass(frozen=True)
class SpectrumConfig:
    """One spectrum of the capture and of the model. The flags may be written without "spectra."."""

    folders: tuple[str, ...] = ()
    """Names of the folder with its images, in any case, the usual one first. None: the spectrum's own name. Values of
    more than 8 bits beside displayable images lie in <the usual name>_raw."""
    source: Source = "raw"
    """What its images are. "photograph": colours. "color": pseudo-colours, whose palette gives a scalar. "raw": one
    value per pixel. "auto": pseudo-colours where the capture has them, else values. "labels": 8-bit grey, the number of
    a class (``classes``); 255 is no class. "features" and "bands": stacks of ``channels``, of which directions count
    (feature maps of CLIP or DINO), or values (hyperspectral)."""
    classes: tuple[str, ...] = ()
    """Names of the classes 0, 1, ... of label images."""
    channels: int = 0
    """Channels of the files of features and bands; 0 of other images."""
    basis: str | None = None
    """File (.npy, [n, channels], n at most 16) with orthonormal rows in which features and bands are learnt. None: the
    principal components of all files."""
    derived: tuple[str, ...] = ()
    """Layers of bands b1, b2, ... that the viewer shows, such as "ndvi = (b4 - b3) / (b4 + b3)"."""
    unit: str = COUNTS
    """Unit of its values. kelvin, celsius, their tenths, hundredths and (of kelvin) thousandths such as centikelvin,
    fahrenheit: temperatures, reported in °C, in any usual spelling. "auto": the capture's own statement (units.json),
    else judged by the values. "counts": none. Any other word is the unit's name, such as reflectance."""
    factor: float = 1.0
    """What values of its files are multiplied by to be in that unit; not for temperatures."""
    range: tuple[float, float] | None = None
    """Values, of temperatures in °C, that the palette's ends, or pixel values 0 and 1, stand for. None: from the
    capture."""
    palette: str | None = "grey"
    """Palette of its pseudo-colours, or of the pictures made of its values: grey, iron, or a file (JSON {"lut": [[r, g,
    b], ...]} or CSV of r,g,b rows, 0-255). None: the capture's ironbow_lut.json, else the palette stored in the first
    image by FLIR, else FLIR Iron."""
    aligned: bool = False
    """Its images are registered to the first spectrum's views although their size or folder does not say so."""
    opacity: Opacity = "shared"
    """Opacity of the Gaussians in this spectrum, where they also render another: the first spectrum's; that one moved
    by an offset, α_s = sigmoid(logit α + Δ), so that both move together until images say otherwise (ThermoSplat); or a
    logit of its own (MMOne). The first spectrum has α itself."""
    modulated_by: str | None = None
    """Spectrum whose prior modulates the decoded image (ThermoSplat, feature modulation). Where that one is not
    modelled, the first other spectrum takes its place. None: the image is decoded from a prior of its own."""
    start: str = "points"
    """What a set of Gaussians of its own starts from: the sparse points, or the set of the spectrum named here as it is
    when training of this one begins (ThermalGaussian MFTG, with ``train_from``)."""
    loss: float = 1.0
    """Weight of its image loss. ThermoSplat."""
    features: float | None = 0.5
    """Factor of the loss on the latent channels that are supervised with its images; ``loss.features`` multiplies it.
    null: no channel is supervised with it. ThermoSplat: 1 for RGB, η = 0.5 for thermal."""
    smoothness: float = 0.0
    """Weight of the mean absolute gradient of its image. ThermoSplat: λ_sm = 0.3 for thermal."""
    squared: float = 0.0
    """k of |d| + k d² in place of |d| in the loss on its images, in their units (0 to 1): PSNR is of squares, in which
    large differences count for more. 0: plain L1. Open choice."""
    swept_depth: float = 0.0
    """Weight of the loss on its depths, the mean difference of log z from those that a plane sweep of its training
    images finds. It counts in steps with images of full size. 0: no sweep. Open choice."""
    point_spread: float = 0.0
    """Blur of its images to begin with, as the standard deviation of a Gaussian [of an image's width]; it is learnt
    with the scene. 0: none. Open choice."""
    by_noise: bool = False
    """The noise of its training images, which is measured, decides how much of this they need: the noisier they are,
    the more smoothness and the less weight above 1, and images of a noisy sensor have no point spread
    (training/sensor_facts.py). Off: ``loss``, ``smoothness`` and ``point_spread`` are taken as they are."""
    exposure: Exposure = "fixed"
    """What differs between its training images though the scene does not; held-out images are rendered without.
    "level": each image has a level of its own, as of an uncooled camera that drifts. "affine": gain and level, of
    photographs a matrix of colours (3DGS's exposure compensation). The mean over all training images is held. "fixed":
    nothing."""
    train_from: float = 0.0
    """Share of the steps before the first that trains on its images. ThermalGaussian MFTG 0.5, MS-Splatting 0.4 for
    thermal."""
    train_until: float = 1.0
    """Share of the steps after the last that trains on its images. ThermalGaussian MFTG 0.5 for RGB."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "unit", unit_named(self.unit))


STRUCTURE = ("opacity", "modulated_by", "start", "exposure", "point_spread", "by_noise", "classes", "channels")
"""Fields of ``SpectrumConfig`` that decide which parameters there are: a run goes on with what it began with."""


def unit_named(word: str) -> str:
    """A unit by any usual spelling: "Kelvin", "°C", "deg C", "centi-kelvins", "mK"; another word as it is.

    Args:
        word: What somebody calls it; what is no text stays for the check of types.
    """
    plain = re.sub(r"[\s_°º.-]", "", str(word).replace("℃", "C").replace("℉", "F")).lower()
    plain = re.sub(r"^(deci|centi|milli|)(degrees?|deg)", r"\1", plain)
    for name in (plain, plain.removesuffix("s")):
        unit = re.sub(r"^(deci|centi|milli)(k|c|centigrade)$", lambda parts: parts[1] + _SPELLINGS[parts[2]], name)
        unit = _SPELLINGS.get(unit, unit)
        if unit in (*TEMPERATURE_UNITS, COUNTS, "auto"):
            return unit
    return word


RGB = SpectrumConfig(
    folders=("rgb", "images", "visible", "vis", "color"), source="photograph", modulated_by="thermal", features=1.0
)
THERMAL = SpectrumConfig(
    folders=("thermal", "ir", "tir", "lwir", "infrared"),
    source="auto",
    unit="auto",
    palette=None,
    opacity="offset",
    smoothness=0.3,
)
DEFAULT_SPECTRA: Mapping[str, SpectrumConfig] = {"rgb": RGB, "thermal": THERMAL}
"""The spectra of ThermoSplat."""


@dataclass(frozen=True)
class Spectrum:
    """A spectrum as a model renders it."""

    name: str
    """Its name in files and flags."""
    channels: int
    """Channels of its images: 3 for photographs, pseudo-colours and labels, 1 for values, of stacks those of the basis
    and one for what is left."""
    color_space: ColorSpace
    """What they are: "photograph", "color" (pseudo-colours), "scalar", "labels" (in the colours of classes) or "stack"
    (of channels, in a basis)."""
    opacity: Opacity
    """Which opacity the Gaussians have in it; "shared" for the first spectrum of a set."""
    latent: tuple[int, int]
    """First latent channel that is supervised with its images, and one beyond the last; equal: none is."""
    modulated_by: str | None
    """Spectrum whose prior modulates its decoded image; None: it has a prior of its own."""
    settings: SpectrumConfig = field(default_factory=SpectrumConfig, compare=False)
    """What else was asked for: its formation reads it."""

    @property
    def is_photograph(self) -> bool:
        """Whether its images are colours, not values."""
        return self.color_space == "photograph"


def folder_names(name: str, spectrum: SpectrumConfig) -> tuple[str, ...]:
    """Names of the folder with a spectrum's images, in lower case, the usual one first."""
    return tuple(folder.lower() for folder in spectrum.folders) or (name,)


def latent_channels(spectra: Mapping[str, SpectrumConfig]) -> dict[str, tuple[int, int]]:
    """The latent channels that losses supervise with each spectrum: three per photograph, one per scalar, in order.

    No channel stands for labels and stacks.

    Args:
        spectra: The modelled spectra by name.

    Returns:
        First channel and one beyond the last by name; equal where ``features`` is None.
    """
    found, first = {}, 0
    for name, spectrum in spectra.items():
        counts = {"photograph": 3, "labels": 0, **dict.fromkeys(STACKS, 0)}
        count = 0 if spectrum.features is None else counts.get(spectrum.source, 1)
        found[name] = first, first + count
        first += count
    return found


def model_spectra(
    spectra: Mapping[str, SpectrumConfig], color_spaces: Mapping[str, ColorSpace]
) -> tuple[Spectrum, ...]:
    """The spectra of a model.

    Args:
        spectra: The modelled ones by name, in order.
        color_spaces: What the capture's images of each are.
    """
    latent = latent_channels(spectra)
    return tuple(
        Spectrum(
            name=name,
            channels={"scalar": 1, "stack": LATENT + 1}.get(color_spaces[name], 3),
            color_space=color_spaces[name],
            opacity="shared" if place == 0 else spectrum.opacity,
            latent=latent[name],
            modulated_by=_modulating(name, spectra),
            settings=spectrum,
        )
        for place, (name, spectrum) in enumerate(spectra.items())
    )


def first_photograph(spectra: Sequence[Spectrum]) -> str | None:
    """The spectrum of which SH colours are blended beside features: a photograph that comes first; None: there is none.

    Args:
        spectra: All of a model, in order.
    """
    return spectra[0].name if spectra[0].is_photograph else None


def _modulating(name: str, spectra: Mapping[str, SpectrumConfig]) -> str | None:
    """The spectrum whose prior modulates another; one that is not modelled where there is no other at all."""
    wanted = spectra[name].modulated_by
    if wanted is None or wanted in spectra:
        return wanted
    return next((other for other in spectra if other != name and spectra[other].modulated_by is None), wanted)


def label(name: str) -> str:
    """A spectrum's name for people: "RGB", "NIR", "thermal", "red edge"."""
    return name.upper() if len(name) <= 3 else name.replace("_", " ")


def listed(names: Sequence[str]) -> str:
    """Names in a sentence: "RGB, NIR and thermal"."""
    labels = [label(name) for name in names]
    return labels[0] if len(labels) == 1 else f"{', '.join(labels[:-1])} and {labels[-1]}"


class MeasuredError(NamedTuple):
    """How people are told an error of measured values."""

    heading: str
    """"MAE" or "bias"."""
    unit: str
    """For people."""
    sign: str
    """Begin of its format: "+" where it may have either sign."""


def measured_error(metric: str) -> MeasuredError | None:
    """What a metric's name says: "mae_celsius" is the MAE in °C; None of another metric.

    Args:
        metric: As in metrics.json.
    """
    for begin, heading, sign in ((MAE, "MAE", ""), (BIAS, "bias", "+")):
        if metric.startswith(begin):
            return MeasuredError(heading, unit_label(metric.removeprefix(begin)), sign)
    return None


def unit_label(unit: str) -> str:
    """A unit for people: "°C", "reflectance"."""
    return "°C" if unit == CELSIUS else unit
