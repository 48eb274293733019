"""The folder a training run writes, and what lies where in it.

ckpts/step_006000.pt   checkpoints           config.yaml       the resolved configuration; reproduces the run
stats/                 metrics per step      environment.json  versions, device and threads
renders/               PNG strips            metrics.jsonl     one line per log interval and evaluation
ply/                   exported Gaussians    metrics.json      the final numbers
exports/               other formats, maps    regions.json      errors by region, where there is ground truth
videos/                camera paths
refined/               refined cameras, as a COLMAP model
tb/                    TensorBoard events     training.lock     the process that trains here, as long as it does
pixels/                undistorted images of a capture larger than memory, as long as it is trained on
"""

import json
import math
import os
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from thermosplat.errors import UserError
from thermosplat.runs.atomic_writes import plain_folder, write_text
from thermosplat.runs.checkpoint_file import load_checkpoint
from thermosplat.runs.environment import environment
from thermosplat.runs.run_lock import run_lock
from thermosplat.runs.written_files import CHECKPOINT_NAME, FILES, delete_run, sweep_run

if TYPE_CHECKING:
    from thermosplat.config import TrainConfig


class FolderGoneError(UserError):
    """A result folder is no longer where it was when its training began.

    Args:
        path: Where it was.
        now: Where it is; None: it was removed.
    """

    def __init__(self, path: Path, now: Path | None) -> None:
        became = "removed" if now is None else f"renamed to {now}"
        super().__init__(f"The result folder {path} was {became} during the training.")
        self.now = now


class RunDirectory:
    """Paths of one run. The folders are made when they are first asked for.

    Args:
        path: The result folder, as the user gave it.
        devices: How many ``resume_command`` asks for.
    """

    def __init__(self, path: str | Path, devices: int = 1) -> None:
        self.devices = devices
        self.path = Path(os.path.expanduser(path))  # as a shell leaves it in --result-dir=~/run, and YAML
        self._opened: int | None = None
        """The locked folder, by whatever name."""

    @classmethod
    def create(cls, path: str | Path, overwrite: bool = False) -> "RunDirectory":
        """Start a run in a folder.

        Args:
            path: The result folder; made where there is none. Files that no run wrote are left alone.

        Raises:
            UserError: If the folder already holds a run, or is a file.
        """
        run = cls(path)
        run._check_is_no_file()
        if run.holds_a_run():
            if not overwrite:
                latest = run.latest_checkpoint()
                steps = f"{checkpoint_step(latest):,} steps" if latest else "no checkpoint yet"
                resume = f"Go on with it: --resume {shlex.quote(str(run.path))}. Or start" if latest else "Start"
                raise UserError(
                    f"{run.path} already holds a run ({steps}).",
                    f"Keep it and start another: --result-dir NEW. {resume} again in its place: --overwrite.",
                )
            delete_run(run.path)
        run._make()
        return run

    @classmethod
    def open(cls, path: str | Path) -> "RunDirectory":
        """An existing run.

        Raises:
            UserError: If there is none at ``path``.
        """
        run = cls(path)
        if not run.holds_a_run():
            there = "that is a file" if run.path.exists() else "there is no such folder"
            what = "the folder holds no run" if run.path.is_dir() else there
            raise UserError(
                f"No training run in {run.path}: {what}.", "Give the --result-dir of a thermosplat-train run."
            )
        return run

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Around what trains here: no other process does meanwhile. The result folder is made.

        Raises:
            UserError: If another process trains here, or the folder cannot be made.
        """
        self._check_is_no_file()
        self._make()
        with run_lock(self.path):
            if self._opened is not None:
                yield
                return
            self._opened = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY)
            try:
                yield
            finally:
                os.close(self._opened)
                self._opened = None

    def check_is_free(self) -> None:
        """Whether nobody trains here.

        Raises:
            UserError: Another process does.
        """
        with self.locked():
            pass

    def check_is_there(self) -> None:
        """Whether the folder is still the one that was locked.

        Raises:
            FolderGoneError: It was renamed, removed or replaced.
        """
        if self._opened is None or _is_folder(self.path, self._opened):
            return
        now = Path(os.readlink(f"/proc/self/fd/{self._opened}"))
        raise FolderGoneError(self.path, now if _is_folder(now, self._opened) else None)

    def move(self, now: Path | None) -> None:
        """Write somewhere else from now on.

        Args:
            now: The folder. None: a new one where it was; beside that if another run has begun there.
        """
        if now is None:
            now = self.path.with_name(f"{self.path.name}_removed") if self.config_yaml.exists() else self.path
        self.path = now
        self._make()
        if self._opened is not None:
            os.close(self._opened)
            self._opened = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY)

    def holds_a_run(self) -> bool:
        """Whether a training run has written here."""
        return any((self.path / name).is_file() for name in FILES) or self.latest_checkpoint() is not None

    def _check_is_no_file(self) -> None:
        if self.path.exists() and not self.path.is_dir():
            raise UserError(f"{self.path} is a file; the result folder cannot go there.", "Give another --result-dir.")

    def _make(self) -> None:
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(
                f"Could not make the result folder {self.path}: {error.strerror}.", "Give another --result-dir."
            ) from error

    def _folder(self, name: str) -> Path:
        return plain_folder(self.path, name)

    @property
    def ckpts(self) -> Path:
        """Folder of the checkpoints."""
        return self._folder("ckpts")

    @property
    def stats(self) -> Path:
        """Folder of the evaluations' numbers."""
        return self._folder("stats")

    @property
    def renders(self) -> Path:
        """Folder of the PNG strips."""
        return self._folder("renders")

    @property
    def ply(self) -> Path:
        """Folder of the exported Gaussians."""
        return self._folder("ply")

    @property
    def exports(self) -> Path:
        """Folder of what other programs open, PLY splats apart."""
        return self._folder("exports")

    @property
    def videos(self) -> Path:
        """Folder of the rendered camera paths."""
        return self._folder("videos")

    @property
    def refined(self) -> Path:
        """Folder of the refined cameras."""
        return self._folder("refined")

    def pictures(self, folder: str, name: str) -> Path:
        """A folder of pictures in "renders" or "videos"."""
        return plain_folder(self.path, folder, name)

    def sweep(self) -> None:
        """Delete the temporary files that killed processes left; nobody else trains here meanwhile."""
        sweep_run(self.path)

    @property
    def tb(self) -> Path:
        """Folder of the TensorBoard events."""
        return self._folder("tb")

    @property
    def config_yaml(self) -> Path:
        """The resolved configuration."""
        return self.path / "config.yaml"

    @property
    def metrics_json(self) -> Path:
        """The final numbers."""
        return self.path / "metrics.json"

    @property
    def regions_json(self) -> Path:
        """The errors by region; not there where the capture has no ground truth."""
        return self.path / "regions.json"

    @property
    def metrics_jsonl(self) -> Path:
        """The numbers over the steps."""
        return self.path / "metrics.jsonl"

    @property
    def environment_json(self) -> Path:
        """What the run ran on."""
        return self.path / "environment.json"

    def checkpoint(self, step: int) -> Path:
        """Path of the checkpoint of a step."""
        return self.ckpts / f"step_{step:06d}.pt"

    def latest_checkpoint(self) -> Path | None:
        """The checkpoint with the most steps, or None where there is none."""
        return next(reversed(self.checkpoints()), None)

    def checkpoints(self) -> list[Path]:
        """All checkpoints, by their steps. Files that the user named otherwise (step_best.pt) are not among them."""
        found = [file for file in (self.path / "ckpts").glob("step_*.pt") if CHECKPOINT_NAME.fullmatch(file.name)]
        return sorted(found, key=checkpoint_step)

    def resume_command(self) -> str:
        """The command line that goes on with this run."""
        devices = f" --devices {self.devices}" if self.devices > 1 else ""
        return f"thermosplat-train --resume {shlex.quote(str(self.path))}{devices}"

    def read_config(self) -> "TrainConfig":
        """The configuration of the run: its config.yaml, or what its newest checkpoint says where that is gone.

        Raises:
            UserError: There is neither, or it cannot be read.
        """
        from thermosplat.config.files import load_config

        if self.config_yaml.is_file():
            return load_config(self.config_yaml)
        path = self.latest_checkpoint()
        if path is None:
            raise UserError(
                f"{self.path} has neither a config.yaml nor a checkpoint to go on from.",
                "Start again with --overwrite.",
            )
        return load_checkpoint(path).config

    def write_config(self, config: "TrainConfig") -> None:
        """Write ``config.yaml``."""
        from thermosplat.config.files import to_yaml

        text = to_yaml(config)
        write_text(self.config_yaml, text)

    def write_environment(self, device: torch.device) -> None:
        """Write ``environment.json``: versions, device and threads, so that numbers can be traced to a machine."""
        self.write_json(self.environment_json, environment(device))

    def write_json(self, path: Path, value: dict[str, Any]) -> None:
        """Write a JSON file, atomically.

        Args:
            value: Plain types. Numbers that are not finite become null: JSON has none.
        """
        text = json.dumps(finite_or_null(value), indent=2, allow_nan=False) + "\n"
        write_text(path, text)


def _is_folder(path: Path, opened: int) -> bool:
    """Whether a path leads to an open folder."""
    try:
        return os.path.samestat(os.stat(path), os.fstat(opened))
    except OSError:
        return False


def checkpoint_step(path: Path) -> int:
    """The step in a checkpoint's file name, ``step_000411.pt``."""
    match = CHECKPOINT_NAME.fullmatch(path.name)
    if match is None:
        raise ValueError(f"expected a checkpoint named step_<number>.pt, got {path.name}")
    return int(match[1])


def finite_or_null(value: Any) -> Any:
    """A JSON value with None in place of every number that is not finite."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: finite_or_null(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite_or_null(item) for item in value]
    return value
