"""The arguments of thermosplat-train: a preset, the flags on top of it, and what a resumed run already fixes."""

import dataclasses
import shlex
from pathlib import Path
from typing import Annotated, Any

import tyro

from thermosplat.cli.command_line import parse_command_line
from thermosplat.cli.first_flags import ALL, print_first_flags
from thermosplat.cli.foreign_flags import refuse_foreign_flags, without_gone_flags
from thermosplat.cli.spectrum_flags import named_spectra, refuse_unknown_spectra, with_groups
from thermosplat.cli.viewer_flags import LOCAL_HOST, viewer_flags, with_viewer_port
from thermosplat.config import TrainConfig
from thermosplat.config.capture_settings import with_recommendations
from thermosplat.config.checks import check_config, flattened
from thermosplat.config.files import files_from_anywhere, load_config, with_given_steps
from thermosplat.config.run_schedule import in_steps
from thermosplat.config.values import fill
from thermosplat.errors import UserError

DEFAULT_PRESET = "thermosplat_plus"
"""In both spectra ahead of the paper's or even, on every capture that was measured: repeated-trainings.md and
low-light.md of benchmarks/records."""
SAMPLE_PRESET = "demo"

HELP_FLAGS = ("-h", "--help", ALL)
MAY_CHANGE_ON_RESUME = frozenset(
    {
        "data",
        "max_steps",
        "steps_for_views",
        "noisy_steps",
        "eval_steps",
        "save_steps",
        "log_every",
        "tensorboard",
        "lpips_weights",
        "device",
        "image_memory",
        "offload",
        "gpu_memory",
    }
)
"""Fields that say how a run is watched or how long it goes, not what is trained; ``data`` for a capture that moved."""
REMEDIES_ON_RESUME = ("data_factor", "optimizer.", "densification.")
"""What may have to change for a run to go on after its memory was full or its loss became NaN."""


@dataclasses.dataclass(frozen=True)
class TrainArguments(TrainConfig):
    """Train 3D Gaussians of several spectra on a capture, and evaluate them on its held-out views.

    Settings of one spectrum are flags with its name: --thermal.unit celsius.

    Examples:
      thermosplat-train sample
      thermosplat-train data/shed --data-factor 2 --result-dir results/shed
      thermosplat-train data/shed --config 3dgs --max-steps 7000
      thermosplat-train --resume results/shed
      thermosplat-train data/shed --devices 4
    """

    data: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")] = ""
    overwrite: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    viewer: Annotated[int | None, tyro.conf.arg(metavar="[PORT]")] = None
    """Show the training in the browser as it goes on, at this port of this machine, of several hosts rank 0's; 8080
    without a number. None: do not."""
    viewer_host: str = LOCAL_HOST
    """Address of the viewer. Others than this machine's own can be reached from elsewhere: the page's address then has
    a random token in it."""
    devices: int | None = None
    """Train on so many devices of this machine, each with a process and a share of the Gaussians. None: one."""
    debug: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Show the traceback of an error."""


def parse_train_arguments(argv: list[str], measured: dict[str, Any] | None = None) -> TrainConfig:
    """The configuration that a command line asks for.

    It is parsed twice: once to see which preset or run it starts from, then with that one's values as the defaults, so
    that flags override the preset and --help shows the preset's values.

    Args:
        measured: Settings by nested names that stand between those of the capture's train.yaml and the flags.

    Returns:
        The configuration. With ``resume`` set it is the run's own, with the changes that a resumed run may have.

    Raises:
        UserError: No capture, an unknown preset or spectrum, a value out of range, another trainer's flag, or flags
            that contradict the resumed run.
        SystemExit: Code 0 after --help, --help-all or --version, code 2 after flags that tyro cannot understand.
    """
    refuse_foreign_flags(argv)
    argv = without_gone_flags(argv)
    start = TrainConfig(config="")
    start = dataclasses.replace(start, spectra=named_spectra(argv, start.spectra))
    first = _parse([word for word in argv if word not in HELP_FLAGS], start)
    viewer_flags(argv)  # says now, not when all is loaded, that there is no such port
    if first.resume is not None:
        return _resumed(argv, first)
    name = first.config or (SAMPLE_PRESET if first.data == "sample" else DEFAULT_PRESET)
    preset = load_config(name)
    if preset.resume is not None:
        raise UserError(
            f"{name} has resume: {preset.resume}, which no configuration file can ask for.",
            f"Take that line out and give the flag: thermosplat-train --resume {shlex.quote(preset.resume)}",
        )
    preset, recommended = with_recommendations(preset, first.data)
    if measured is not None:
        preset = fill(preset, measured, source="what the images say")
    config = files_from_anywhere(dataclasses.replace(_parse(argv, preset), config=preset.config))
    if recommended is not None and measured is None:
        print(f"Settings of {recommended} are taken where the command line says nothing else.")
    if not config.data:
        raise UserError(
            "No capture given.", 'Say which: thermosplat-train FOLDER, or "thermosplat-train sample" for a first try.'
        )
    check_config(config)
    return config


def with_measured(argv: list[str], config: TrainConfig, measured: dict[str, Any]) -> TrainConfig:
    """The configuration that a command line asks for, with what the images of the capture recommend.

    Args:
        config: What ``parse_train_arguments`` made of them.
    """
    changed = parse_train_arguments(argv, measured) if measured else config
    taken = [f"{key} {_words(value)}" for key, _, value in _differences(config, changed)]
    if taken:
        print(f"Taken since the command line says nothing else: {', '.join(taken)}.")
    return changed


def _words(value: object) -> str:
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _resumed(argv: list[str], first: TrainConfig) -> TrainConfig:
    from thermosplat.runs.run_directory import RunDirectory

    folder = str(first.resume)
    run = RunDirectory.open(folder)
    run.check_is_free()  # before anybody is told to start again in its place
    run_config = run.read_config()
    start = files_from_anywhere(dataclasses.replace(run_config, resume=folder, result_dir=folder))
    asked = files_from_anywhere(_parse(argv, start))
    if asked.overwrite:
        raise UserError("--resume goes on with a run and --overwrite deletes it.", "Give one of them.")
    if Path(asked.config).stem == start.config:
        asked = dataclasses.replace(asked, config=start.config)
    if asked.result_dir and Path(asked.result_dir).resolve() == Path(folder).resolve():
        asked = dataclasses.replace(asked, result_dir=folder)
    for key, trained, wanted in _differences(start, asked):
        if key not in MAY_CHANGE_ON_RESUME and not key.startswith(REMEDIES_ON_RESUME):
            raise UserError(
                f"{folder} was trained with {key}={trained}, the command asks for {wanted}.",
                "Leave that flag out, or start another run with --result-dir.",
            )
    if asked.max_steps < run_config.max_steps:
        raise UserError(
            f"{folder} was to be trained for {run_config.max_steps} steps, the command asks for {asked.max_steps}.",
            "A resumed run can have more steps, not fewer: leave out --max-steps.",
        )
    if asked.max_steps > run_config.max_steps:  # what it has done, it has done
        asked = in_steps(asked, run_config.max_steps)
    check_config(asked)
    return asked


def _parse(argv: list[str], default: TrainConfig) -> TrainConfig:
    refuse_unknown_spectra(argv, default.spectra)
    if _gives(argv, "--max-steps"):
        default = dataclasses.replace(default, **with_given_steps({"max_steps": default.max_steps}))
    start = TrainArguments(**{field.name: getattr(default, field.name) for field in dataclasses.fields(TrainConfig)})
    if ALL in argv:
        argv = ["--help"]
    elif not set(HELP_FLAGS).isdisjoint(argv):
        print_first_flags(start)
    argv = with_viewer_port(with_groups(argv, default.spectra))
    arguments = parse_command_line(TrainArguments, argv, prog="thermosplat-train", default=start)
    return TrainConfig(**{field.name: getattr(arguments, field.name) for field in dataclasses.fields(TrainConfig)})


def _gives(argv: list[str], flag: str) -> bool:
    """Whether a flag is among the words, also with underscores and with its value behind "="."""
    return any(word.partition("=")[0].replace("_", "-") == flag for word in argv)


def _differences(one: TrainConfig, other: TrainConfig) -> list[tuple[str, object, object]]:
    """Dotted names and both values of the fields in which two configurations differ."""
    pairs = zip(flattened(one), flattened(other))
    return [(key, value, changed) for (key, value), (_, changed) in pairs if value != changed]
