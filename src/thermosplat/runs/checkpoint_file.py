"""Checkpoints as files: written so that a crash never leaves half of one, and read as data that may come from anybody.

torch's archive is a zip file of one pickle and of the tensors' bytes. Before torch reads it, every member is held
against its check sum, nothing in it may unpack to more than its size, and the pickle may name nothing but tensors.
"""

import contextlib
import pickletools
import zipfile
from pathlib import Path
from typing import Any

import torch

from thermosplat.errors import UserError
from thermosplat.runs.atomic_writes import write_atomically
from thermosplat.runs.checkpoint import DELETE_IT, FORMAT, Checkpoint
from thermosplat.runs.written_files import CHECKPOINT_NAME

_DTYPES = {
    "Half": torch.float16,
    "Float": torch.float32,
    "Double": torch.float64,
    "BFloat16": torch.bfloat16,
    "Bool": torch.bool,
    "Byte": torch.uint8,
    "Int": torch.int32,
    "Long": torch.int64,
}
"""What tensors may hold, by the names of torch's storages."""
_NAMED = {f"torch {kind}Storage" for kind in _DTYPES}
_NAMED |= {"collections OrderedDict", "torch._utils _rebuild_tensor_v2", "torch._utils _rebuild_parameter"}
"""What the pickle of a checkpoint may name: tensors, by the kinds of their storages, and state_dict's dictionary."""
_NAMING = ("GLOBAL", "STACK_GLOBAL", "INST", "EXT1", "EXT2", "EXT4")
"""Operations of a pickle that bring in something by its name."""


class _DamagedError(Exception):
    """What is wrong with a file."""


def save_checkpoint(path: Path, state: dict[str, Any]) -> Path:
    """Write a checkpoint, atomically.

    Args:
        state: Its content (``Checkpoint.state``).

    Raises:
        NotWrittenError: If the file cannot be written.
    """

    def write(temporary: Path) -> None:
        try:
            with temporary.open("wb") as file:
                torch.save({"format": FORMAT, **state}, file)
        except RuntimeError as error:  # torch's archive writer hides the OSError of a full disk in its own error
            if isinstance(error.__context__, OSError):
                raise error.__context__ from error
            raise

    write_atomically(path, write)
    return path


@torch.no_grad()
def on_host(state: Any) -> Any:
    """A checkpoint's content in tensors of its own, in the host's memory, which no training changes.

    Args:
        state: Tensors and built-in types, in dicts, lists and tuples.
    """
    if isinstance(state, torch.Tensor):
        return state.to("cpu", copy=True)
    if isinstance(state, dict):
        return {key: on_host(value) for key, value in state.items()}
    if isinstance(state, list | tuple):
        return type(state)(on_host(value) for value in state)
    return state


def num_stored_bytes(state: Any) -> int:
    """Bytes of the tensors in a checkpoint's content; its file is a little larger."""
    if isinstance(state, torch.Tensor):
        return state.numel() * state.element_size()
    if isinstance(state, dict):
        return sum(map(num_stored_bytes, state.values()))
    return sum(map(num_stored_bytes, state)) if isinstance(state, list | tuple) else 0


def load_checkpoint(path: Path, device: torch.device | str = "cpu") -> Checkpoint:
    """Read a checkpoint.

    Raises:
        UserError: If there is no such file, it is damaged, not a checkpoint that this version reads, or holds another
            step than its name says.
    """
    if not path.is_file():
        raise UserError(f"No checkpoint at {path}.", "Give the result folder of a run of thermosplat-train.")
    try:
        _check_archive(path)
        state = _read(path, device)
        _check_content(state)
    except (_DamagedError, OSError, RecursionError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise UserError(f"{path} is damaged or not a thermosplat checkpoint ({reason}).", DELETE_IT) from error
    if not isinstance(state, dict) or not isinstance(state.get("format"), int):
        raise UserError(f"{path} is not a thermosplat checkpoint: it has no format number.")
    if state["format"] != FORMAT:
        raise UserError(
            f"{path} has checkpoint format {state['format']}; this version of thermosplat reads format {FORMAT}.",
            "Use the version of thermosplat that wrote it.",
        )
    checkpoint = Checkpoint.from_state(state, path)
    _check_name(path, checkpoint.step)
    return checkpoint


def _check_name(path: Path, step: int) -> None:
    """Refuse a checkpoint whose name says another step than it holds: a run would go on from the wrong one."""
    named = CHECKPOINT_NAME.fullmatch(path.name)
    if named is not None and int(named[1]) != step:
        right = path.with_name(f"step_{step:06d}.pt")
        raise UserError(f"{path} holds step {step:,}, not the step of its name.", f"Rename it: mv {path} {right}")


def _check_archive(path: Path) -> None:
    """Hold a file's bytes against its check sums, and what it names against what a checkpoint may name."""
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            names = [member.filename for member in members]
            if any(member.compress_type != zipfile.ZIP_STORED for member in members):
                raise _DamagedError("a part of it is compressed")
            if sum(member.file_size for member in members) > path.stat().st_size or len(set(names)) < len(names):
                raise _DamagedError("its parts are more than the file holds")
            if (bad := archive.testzip()) is not None:
                raise _DamagedError(f"the check sum of its part {bad} is wrong")
            pickles = [name for name in names if name.endswith("data.pkl")]
            if len(pickles) != 1:
                raise _DamagedError("it has no content")
            _check_names(archive.read(pickles[0]))
    except zipfile.BadZipFile as error:
        raise _DamagedError(str(error)) from error
    except (RuntimeError, ValueError, EOFError, OverflowError, zipfile.LargeZipFile) as error:
        raise _DamagedError("its table of contents cannot be read") from error  # encrypted, or of a later kind


def _check_names(pickled: bytes) -> None:
    """Refuse a pickle that names anything but tensors, without running it."""
    for operation, argument, _ in pickletools.genops(pickled):
        if operation.name in _NAMING and argument not in _NAMED:
            wanted = str(argument).replace(" ", ".") if operation.name in ("GLOBAL", "INST") else "an object"
            raise _DamagedError(f"it asks for {wanted[:80]}, which no checkpoint holds")


def _read(path: Path, device: torch.device | str) -> Any:
    try:
        return torch.load(path, map_location=device, weights_only=True)
    except (MemoryError, torch.OutOfMemoryError, OSError):
        raise
    except Exception as error:  # of bytes from strangers torch's reader may raise anything, with advice of its own
        raise _DamagedError("torch cannot read its content") from error


def _check_content(state: Any) -> None:
    """Refuse what no checkpoint holds: other types, and tensors that claim more than is stored of them."""
    waiting, seen = [state], set()
    while waiting:
        value = waiting.pop()
        if isinstance(value, dict | list | tuple):
            if id(value) not in seen:
                seen.add(id(value))
                waiting += [*value.keys(), *value.values()] if isinstance(value, dict) else value
        elif isinstance(value, torch.Tensor):
            _check_tensor(value)
        elif not isinstance(value, bool | int | float | str | None):
            raise _DamagedError(f"it holds a {type(value).__name__}")


def _check_tensor(tensor: torch.Tensor) -> None:
    usual = tensor.layout == torch.strided and tensor.dtype in _DTYPES.values() and not tensor.is_meta
    stored = 0
    with contextlib.suppress(NotImplementedError, RuntimeError):  # a kind of tensor without a storage
        stored = tensor.untyped_storage().nbytes()
    if not usual or tensor.numel() * tensor.element_size() > stored:
        raise _DamagedError(f"it holds a tensor of {tensor.numel():,} {tensor.dtype} numbers in {stored:,} bytes")
