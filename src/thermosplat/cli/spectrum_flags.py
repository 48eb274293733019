"""Flags of one spectrum: --thermal.unit for --spectra.thermal.unit."""

import dataclasses
import re
from collections.abc import Collection, Iterator, Mapping

from thermosplat.config import TrainConfig
from thermosplat.config.values import nearest
from thermosplat.errors import UserError
from thermosplat.spectra import SpectrumConfig

_GROUPS = frozenset(field.name for field in dataclasses.fields(TrainConfig))
_FIELDS = frozenset(field.name for field in dataclasses.fields(SpectrumConfig))


def with_groups(argv: list[str], spectra: Collection[str]) -> list[str]:
    """A command line with the flags of spectra as the configuration has them."""
    return [_with_group(word, spectra) for word in argv]


def named_spectra(argv: list[str], known: Mapping[str, SpectrumConfig]) -> dict[str, SpectrumConfig]:
    """The known spectra, and those that a command line has flags of: a configuration file may define them."""
    return dict(known) | {name: SpectrumConfig() for _, name in _flags(argv) if name not in known}


def refuse_unknown_spectra(argv: list[str], spectra: Collection[str]) -> None:
    """Say which spectra there are where a command line has a flag of another.

    Raises:
        UserError: At the first such flag.
    """
    for flag, name in _flags(argv):
        if name not in spectra:
            raise UserError(
                f'{flag}: there is no spectrum "{name}"{nearest(name, spectra)}.',
                f"The spectra are {', '.join(spectra)}; a configuration file defines others (docs/spectra.md): "
                "--config FILE.",
            )


def _flags(argv: list[str]) -> Iterator[tuple[str, str]]:
    """Flags of a spectrum's settings, mistyped ones too, and the spectrum's name."""
    for word in argv:
        found = re.match(r"--(?:spectra\.)?([a-z][\w-]*)\.(?:no-)?([\w-]+)", word)
        if found is not None:
            name, field = (part.replace("-", "_") for part in found.groups())
            if name not in _GROUPS and (field in _FIELDS or nearest(field, _FIELDS)):
                yield found[0], name


def _with_group(word: str, spectra: Collection[str]) -> str:
    found = re.match(r"--([a-z][\w-]*)\.", word)
    return f"--spectra.{word[2:]}" if found is not None and found[1].replace("-", "_") in spectra else word
