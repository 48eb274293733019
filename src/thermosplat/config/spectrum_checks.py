"""What the list of spectra must satisfy: names, ranges, schedules, and what one says of another."""

import dataclasses
import difflib
import re
from collections.abc import Callable, Mapping

from thermosplat.class_colors import MOST_CLASSES
from thermosplat.config import TrainConfig
from thermosplat.config.band_formulas import parsed
from thermosplat.config.values import nearest, shortened
from thermosplat.errors import UserError
from thermosplat.spectra import COUNTS, STACKS, TEMPERATURE_UNITS, SpectrumConfig, folder_names, label

RESERVED = frozenset(
    {
        *("all", "both", "data", "decoders", "evaluation", "exposures", "features", "frame", "gaussians", "loss"),
        *("pixels", "points", "scene", "shared", "spectra", "step", "steps", "train", "test", "visible"),
        *("num_gaussians", "train_seconds", "wall_seconds", "first_step_seconds", "lpips_net", "model_bytes"),
        *("feature_channels", "opacity_offsets_kept", "training_views", "remarks", "formations", "classes"),
        # what torch's ModuleDict and ParameterDict, which hold networks by spectrum, call their own
        *("add_module", "apply", "bfloat16", "buffers", "call_super_init", "children", "clear", "compile", "copy"),
        *("cpu", "cuda", "double", "dump_patches", "eval", "extra_repr", "float", "forward", "fromkeys", "get"),
        *("get_buffer", "get_extra_state", "get_parameter", "get_submodule", "half", "ipu", "items", "keys"),
        *("load_state_dict", "modules", "mtia", "named_buffers", "named_children", "named_modules"),
        *("named_parameters", "parameters", "pop", "popitem", "register_backward_hook", "register_buffer"),
        *("register_forward_hook", "register_forward_pre_hook", "register_full_backward_hook"),
        *("register_full_backward_pre_hook", "register_load_state_dict_post_hook"),
        *("register_load_state_dict_pre_hook", "register_module", "register_parameter"),
        *("register_state_dict_post_hook", "register_state_dict_pre_hook", "requires_grad_", "set_extra_state"),
        *("set_submodule", "setdefault", "share_memory", "state_dict", "to", "to_empty", "training", "type"),
        *("update", "values", "xpu", "zero_grad"),
    }
)
"""Names that files, tables and modules use for something else."""
_OF_IMAGES = {"smoothness": 0.0, "squared": 0.0, "swept_depth": 0.0, "point_spread": 0.0, "by_noise": False} | {
    "exposure": "fixed"
}
"""Settings that labels, features and bands do not have, and what they are then."""
_SHARES = ("train_from", "train_until")
_TEMPERATURE = re.compile("kelvin|celsius|centigrad|fahren|rankine|temperatur")
"""In a unit's name it says that values are temperatures."""
_LIKE_A_UNIT = 0.75
"""Likeness (difflib's ratio) from which on a word is a mistyped unit: "celcius", not "reflectance" or "percent"."""
MOST_CHANNELS = 4096
"""Channels of a stack: their products with each other, which the basis is found of, take 128 MiB."""
MOST_POINT_SPREAD = 0.1
"""Standard deviation of the widest blur that a camera may have [of an image's width]: nothing could be seen beyond it,
and a pixel would take longer than all others."""

Name = Callable[[str], str]


def check_spectra(config: TrainConfig, name: Name) -> None:
    """Look for a list of spectra that no run can work with.

    Args:
        name: Turns a dotted field into what the user calls it.

    Raises:
        UserError: Names what is wrong and what is expected.
    """
    groups = {field.name for field in dataclasses.fields(config)}
    for spectrum in config.spectra:
        if not re.fullmatch("[a-z][a-z0-9_]*", spectrum) or spectrum in RESERVED | groups:
            raise UserError(
                f'{name("spectra")}: "{spectrum}" cannot be the name of a spectrum.',
                "A name has small letters, digits and underscores, begins with a letter, and no setting is called so.",
            )
    for spectrum in config.without:
        if spectrum not in config.spectra:
            known = ", ".join(config.spectra)
            raise UserError(
                f'{name("without")}: there is no spectrum "{spectrum}"{nearest(spectrum, config.spectra)}.',
                f"The spectra are {known}.",
            )
    if not config.modelled:
        raise UserError(f"{name('without')} leaves out all spectra: there is nothing to train.")
    for spectrum, settings in config.spectra.items():
        _check_values(spectrum, settings, config, name)
    _check_folders(config.spectra, name)
    _check_schedule(config, name)


def _check_values(spectrum: str, settings: SpectrumConfig, config: TrainConfig, name: Name) -> None:
    def called(field: str) -> str:
        return name(f"spectra.{spectrum}.{field}")

    if settings.point_spread > MOST_POINT_SPREAD:
        raise UserError(f"{called('point_spread')} must be at most {MOST_POINT_SPREAD}, found {settings.point_spread}.")
    for field in _SHARES:
        value = getattr(settings, field)
        if not 0 <= value <= 1:
            raise UserError(f"{called(field)} must lie between 0 and 1, found {value}.")
    if not settings.factor > 0:
        raise UserError(f"{called('factor')} must be positive, found {settings.factor}.")
    for field, number in vars(settings).items():
        if isinstance(number, int | float) and number < 0:
            raise UserError(f"{called(field)} must be zero or positive, found {number}.")
    if spectrum in config.modelled and not settings.train_from < settings.train_until:
        raise UserError(
            f"{called('train_from')} {settings.train_from} must be below {called('train_until')} "
            f"{settings.train_until}: no step would train on {label(spectrum)} images.",
            f"To leave them out: --without {spectrum}.",
        )
    span = settings.range
    if span is not None and not span[0] < span[1]:
        raise UserError(
            f"{called('range')} must rise from the lowest to the highest value, found {span[0]} to {span[1]}."
        )
    if not re.fullmatch("[A-Za-z0-9_/^-]+", settings.unit):
        raise UserError(f"{called('unit')} must be one word, found {settings.unit!r}.", "For example: reflectance")
    _check_unit(settings.unit, called("unit"))
    _check_classes(settings, called("classes"))
    _check_stack(settings, called)
    if settings.source in ("labels", *STACKS):
        for field, usual in _OF_IMAGES.items():
            if getattr(settings, field) != usual:
                raise UserError(
                    f"{called(field)} is of images that a camera took, and {label(spectrum)} ({settings.source}) "
                    "was made of them.",
                    "Leave it out.",
                )
    for folder in settings.folders:
        if folder in ("", ".", "..") or "/" in folder or "\\" in folder:
            raise UserError(f"{called('folders')} must be names of folders inside the capture, found {folder!r}.")
    others = [other for other in config.spectra if other != spectrum]
    for field, known in (("modulated_by", others), ("start", ["points", *others])):
        value = getattr(settings, field)
        if value is not None and value not in known:
            raise UserError(
                f"{called(field)} must be another spectrum, found {value!r}{nearest(value, known)}.",
                f"There are: {', '.join(known) or 'no others'}.",
            )


def _check_classes(settings: SpectrumConfig, called: str) -> None:
    """Labels have names for their classes, and nothing else has."""
    names = settings.classes
    expected = f"between 2 and {MOST_CLASSES} different names" if settings.source == "labels" else "none"
    right = 2 <= len(names) <= MOST_CLASSES and all(map(str.strip, names)) if settings.source == "labels" else not names
    if not right or len(set(names)) < len(names):
        raise UserError(
            f"{called} must be {expected} where source is {settings.source}, found {len(names)}: "
            f"{shortened(', '.join(names)) or 'none'}.",
            "In a YAML file: labels: {source: labels, classes: [background, window, door]}",
        )


def _check_stack(settings: SpectrumConfig, called: Name) -> None:
    """Stacks have channels, and nothing else has; formulas are of bands."""
    if (settings.source in STACKS) != (settings.channels > 0):
        expected = f"1 to {MOST_CHANNELS:,}" if settings.source in STACKS else "0"
        raise UserError(
            f"{called('channels')} must be {expected} where source is {settings.source}, found {settings.channels}.",
            "In a YAML file: nir: {source: bands, channels: 31}",
        )
    if settings.channels > MOST_CHANNELS:
        raise UserError(f"{called('channels')} must be at most {MOST_CHANNELS:,}, found {settings.channels:,}.")
    if settings.derived and settings.source != "bands":
        raise UserError(f"{called('derived')} are layers of bands, and source is {settings.source}.")
    names = [parsed(text, settings.channels, called("derived")).name for text in settings.derived]
    if len(set(names)) < len(names):
        raise UserError(f"{called('derived')} gives two layers one name: {', '.join(names)}.")


def _check_unit(unit: str, called: str) -> None:
    """Refuse a word that is nearly a known unit: as a word of the user's own, nothing would be converted."""
    known = (*TEMPERATURE_UNITS, COUNTS)
    plain = unit.lower()
    if unit in (*known, "auto"):
        return
    if _TEMPERATURE.search(plain) or difflib.get_close_matches(plain, known, n=1, cutoff=_LIKE_A_UNIT):
        raise UserError(
            f"{called}: {unit} is no unit that is known{nearest(unit, known)}.",
            f"Known are {', '.join(known)} and auto. Another quantity is called by another word, such as reflectance.",
        )


def _check_folders(spectra: Mapping[str, SpectrumConfig], name: Name) -> None:
    """Refuse spectra that would read the same images."""
    owners: dict[str, str] = {}
    for spectrum, settings in spectra.items():
        folders = folder_names(spectrum, settings)
        for folder in (*folders, f"{folders[0]}_raw"):
            owner = owners.setdefault(folder, spectrum)
            if owner != spectrum:
                raise UserError(
                    f"{folder}/ would hold images of {label(owner)} and of {label(spectrum)}.",
                    f"Give one of them other folders: {name(f'spectra.{spectrum}.folders')}.",
                )


def _check_schedule(config: TrainConfig, name: Name) -> None:
    modelled = config.modelled
    _check_gaps(modelled, name)
    for spectrum, settings in modelled.items():
        if settings.start == "points":
            continue
        if config.model.gaussian_sets != "separate" or settings.start not in modelled:
            raise UserError(
                f"{name(f'spectra.{spectrum}.start')} {settings.start} copies one set of Gaussians to another, which "
                f"needs separate sets of {label(spectrum)} and {label(settings.start)}."
            )
        # steps before each, as SpectrumSchedule counts them
        copied, begins = (round(s.train_from * config.max_steps) for s in (modelled[settings.start], settings))
        if begins <= copied:
            raise UserError(
                f"{name(f'spectra.{spectrum}.start')} {settings.start} copies that set when training of "
                f"{label(spectrum)} begins, and with {name(f'spectra.{spectrum}.train_from')} {settings.train_from} of "
                f"{config.max_steps} steps it begins before {label(settings.start)} has been trained.",
                f"Give {name(f'spectra.{spectrum}.train_from')}, such as 0.5 (--config thermalgaussian_mftg), or start "
                "from points.",
            )


def _check_gaps(modelled: Mapping[str, SpectrumConfig], name: Name) -> None:
    """Refuse a schedule in which some steps train on nothing."""
    reached = 0.0
    for settings in sorted(modelled.values(), key=lambda settings: settings.train_from):
        if settings.train_from > reached:
            break
        reached = max(reached, settings.train_until)
    if reached == 1:
        return
    fields = [
        name(f"spectra.{spectrum}.{field}")
        for spectrum, settings in modelled.items()
        for field, usual in (("train_from", 0.0), ("train_until", 1.0))
        if getattr(settings, field) != usual
    ]
    if len(modelled) == 1:
        raise UserError(
            f"{' and '.join(fields)} would leave steps without anything to train on: only {label(*modelled)} is "
            "modelled.",
            "train_from is 0 then, and train_until 1.",
        )
    raise UserError(
        f"{', '.join(fields[:-1])} and {fields[-1]} leave a gap: after {reached:g} of the steps there is nothing to "
        "train on.",
        "Let one spectrum begin no later than another one ends.",
    )
