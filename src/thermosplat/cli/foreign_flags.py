"""Flags of gsplat, INRIA's 3DGS and nerfstudio, and of settings that are gone: what thermosplat-train has instead.

docs/migrating.md holds the same table for readers.
"""

import dataclasses

from thermosplat.config import TrainConfig
from thermosplat.config.gone_settings import GONE, gone
from thermosplat.errors import UserError

_COUNTERPARTS = {
    "--result-dir": "-m --model-path --output-dir",
    "--data-factor": "-r --resolution --downscale-factor",
    "--test-every": "--eval --eval-mode",
    "--max-steps": "--iterations --max-num-iterations",
    "--sh-degree": "--pipeline.model.sh-degree",
    "--loss.ssim-lambda": "--ssim-lambda --lambda-dssim --pipeline.model.ssim-lambda",
    "--eval-steps": "--test-iterations --steps-per-eval-all-images",
    "--save-steps": "--save-iterations --steps-per-save",
    "--optimizer.means-lr": "--means-lr --position-lr-init --optimizers.means.optimizer.lr",
    "--densification.start-step": "--strategy.refine-start-iter --densify-from-iter --pipeline.model.warmup-length",
    "--densification.stop-step": "--strategy.refine-stop-iter --densify-until-iter --pipeline.model.stop-split-at",
    "--densification.every": "--strategy.refine-every --densification-interval --pipeline.model.refine-every",
    "--densification.reset-every": (
        "--strategy.reset-every --opacity-reset-interval --pipeline.model.reset-alpha-every"
    ),
    "--densification.grad-threshold": (
        "--strategy.grow-grad2d --densify-grad-threshold --pipeline.model.densify-grad-thresh"
    ),
    "--resume": "--ckpt --start-checkpoint --load-dir",
}
_NOTHING = {
    "model.rasterize_mode": "--antialiased --antialiasing --pipeline.model.rasterize-mode",
    "random_background": "--random-bkgd --pipeline.model.background-color",
}
"""Flags that have no counterpart any more, by the setting that they had."""
_DATA = ("-s", "--source-path", "--data", "--data-dir")
_OURS = {flag: ours for ours, flags in _COUNTERPARTS.items() for flag in flags.split()}


def refuse_foreign_flags(argv: list[str]) -> None:
    """Name our own flag where a command line has another trainer's.

    Raises:
        UserError: At the first such flag.
    """
    for word, following in zip(argv, [*argv[1:], "-"]):
        given, _, value = word.partition("=")
        flag = given.replace("_", "-")
        if flag in _DATA:
            folder = value or ("FOLDER" if following.startswith("-") else following)
            raise UserError(
                f"thermosplat-train has no flag {given}.", f"Give the folder without a flag: thermosplat-train {folder}"
            )
        for name, flags in _NOTHING.items():
            if flag in flags.split():
                raise UserError(f"thermosplat-train has no flag {given}.", GONE[name].why)
        if flag in _OURS:
            raise UserError(f"thermosplat-train has no flag {given}.", f"The flag here: {_OURS[flag]}")


_GROUPS = frozenset(field.name for field in dataclasses.fields(TrainConfig))


def without_gone_flags(argv: list[str]) -> list[str]:
    """A command line without flags of settings that there are no more, where they ask for what is done today.

    Raises:
        UserError: At the first such flag that asks for something else.
    """
    kept: list[str] = []
    words = iter(argv)
    for word in words:
        given, equals, text = word.partition("=")
        name, switch = _setting(given)
        of_name = gone(name) if given.startswith("--") else None
        if of_name is None:
            kept.append(word)
            continue
        value: object = switch
        if not isinstance(of_name.neutral[0], bool):
            value = _number_or_text(text if equals else next(words, ""))
        if not of_name.asks_for_today(value):
            raise UserError(of_name.said(given, value), "Leave it out.")
    return kept


def _number_or_text(word: str) -> float | str:
    try:
        return float(word)
    except ValueError:
        return word


def _setting(flag: str) -> tuple[str, bool]:
    """The dotted name of a flag's setting, and what a flag without a value says of it."""
    *groups, key = flag.removeprefix("--").replace("-", "_").split(".")
    if groups and groups[0] not in _GROUPS:
        groups = ["spectra", *groups]
    off = key.startswith("no_") and gone(".".join([*groups, key])) is None
    return ".".join([*groups, key.removeprefix("no_") if off else key]), not off
