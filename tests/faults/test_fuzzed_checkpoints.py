"""Damaged and edited checkpoints: a result or one sentence, never a traceback, a hang, or content that changed unseen.

    THERMOSPLAT_FUZZ_CASES=2000 pytest -s tests/faults/test_fuzzed_checkpoints.py --timeout 0 -o faulthandler_timeout=0

Each case has a number, which is its seed, so that one that fails can be repeated alone.
"""

import copy
import math
import os
import random
import shutil
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from thermosplat.datasets.capture import Capture
from thermosplat.datasets.frame_tensors import frame_tensors
from thermosplat.errors import UserError
from thermosplat.evaluation.loaded_run import load_run
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.training.trainer import Trainer
from toy_run import flat_tensors, many_frames, toy_run_config, toy_trainer
from toy_scene import toy_capture

CASES = int(os.environ.get("THERMOSPLAT_FUZZ_CASES", "120"))
STEP = 3
CONFIG = toy_run_config()
LIMIT_SECONDS = 5.0
"""Of a processor, for a case: a busy machine takes longer."""
LIMIT_BYTES = 2**30
"""Of memory that all of them together take at most, beside what the process had."""


@pytest.fixture(scope="module")
def capture() -> Capture:
    """What the run is trained on."""
    return many_frames(toy_capture())


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory, capture: Capture) -> Path:
    """A checkpoint with moments of Adam and sums of density control."""
    trainer = toy_trainer(tmp_path_factory.mktemp("original"), CONFIG, capture)
    while trainer.step < STEP:
        trainer.train_step()
    return trainer.save()


# ---- damage of bytes: what is read must be what was written ----------------------------------------------------------


def flipped(content: bytes, chance: random.Random) -> bytes:
    """One to three bits are others."""
    damaged = bytearray(content)
    for _ in range(chance.randint(1, 3)):
        damaged[chance.randrange(len(damaged))] ^= 1 << chance.randrange(8)
    return bytes(damaged)


def truncated(content: bytes, chance: random.Random) -> bytes:
    """The end is missing."""
    return content[: chance.randrange(len(content))]


def zeroed(content: bytes, chance: random.Random) -> bytes:
    """A block is empty, as after a power cut."""
    start, length = chance.randrange(len(content)), chance.choice([1, 64, 4096])
    return (content[:start] + bytes(length) + content[start + length :])[: len(content)]


def shifted(content: bytes, chance: random.Random) -> bytes:
    """Bytes were put in or left out."""
    start, length = chance.randrange(len(content)), chance.randint(1, 64)
    if chance.random() < 0.5:
        return content[:start] + content[start + length :]
    return content[:start] + chance.randbytes(length) + content[start:]


BYTES: tuple[Callable[[bytes, random.Random], bytes], ...] = (flipped, truncated, zeroed, shifted)


# ---- edits: the archive is whole, what it says is something else -----------------------------------------------------


def renamed_members(path: Path, chance: random.Random) -> None:
    """Members of the archive have other names, are twice there or missing; all check sums are right."""
    with zipfile.ZipFile(path) as archive:
        members = [(name, archive.read(name)) for name in archive.namelist()]
    number = chance.randrange(len(members))
    name, content = members[number]
    kind = chance.choice(["rename", "swap", "drop", "pickle"])
    if kind == "rename":
        members[number] = (chance.choice([name + "x", "../" + name, name[:-1], "data.pkl"]), content)
    elif kind == "swap":
        other = chance.randrange(len(members))
        members[number], members[other] = (name, members[other][1]), (members[other][0], content)
    elif kind == "drop":
        del members[number]
    else:
        members = [(n, flipped(c, chance) if n.endswith("data.pkl") else c) for n, c in members]
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members:
            archive.writestr(name, content)


def edited(path: Path, chance: random.Random) -> None:
    """One entry, at any depth, is another value, a tensor of another shape or type, or missing."""
    state = copy.deepcopy(torch.load(path, weights_only=True))
    entries: Any = state
    while True:
        keys = list(entries) if isinstance(entries, dict) else list(range(len(entries)))
        key = chance.choice(keys)
        inner = entries[key]
        if not (isinstance(inner, dict | list) and inner) or chance.random() < 0.15:
            break
        entries = inner
    if chance.random() < 0.2:
        del entries[key]
    else:
        entries[key] = other_tensor(inner, chance) if isinstance(inner, torch.Tensor) else other_value(chance)
    torch.save(state, path)


def other_tensor(tensor: torch.Tensor, chance: random.Random) -> object:
    """A tensor like another one."""
    kinds: list[Callable[[], object]] = [
        lambda: tensor[:5] if tensor.ndim else tensor[None],
        lambda: tensor.T.contiguous() if tensor.ndim == 2 else tensor[None],
        lambda: tensor.double(),
        lambda: tensor.long(),
        lambda: tensor.to_sparse() if tensor.ndim else tensor.bool(),
        lambda: torch.full_like(tensor, math.nan if tensor.is_floating_point() else 255),
        lambda: torch.full_like(tensor, 1e38 if tensor.is_floating_point() else 1),
        lambda: tensor.flatten()[:1].expand(10**12) if tensor.numel() else tensor.double(),
        lambda: tensor[:0] if tensor.ndim else tensor.half(),
        lambda: other_value(chance),
    ]
    return chance.choice(kinds)()


def other_value(chance: random.Random) -> object:
    """Something that is no tensor, or one that nobody expects there."""
    values = [None, True, -1, 0, 5, 10**400, 2**63, 1e308, math.nan, "", "x" * 5000, [], {}, {"a": {}}, [[[]]], (1, 2)]
    return chance.choice([*values, torch.zeros(3), torch.tensor(7)])


EDITS: tuple[Callable[[Path, random.Random], None], ...] = (renamed_members, edited, edited, edited)


def values_of(path: Path) -> dict[str, torch.Tensor]:
    """All tensors of a checkpoint, read by torch."""
    return flat_tensors(torch.load(path, weights_only=True))


def used(run: Path, capture: Capture) -> None:
    """Render the run, and train it one step further; a user's error of the one does not spare the other."""
    errors: list[UserError] = []
    try:
        loaded = load_run(str(run), device="cpu")
        views = frame_tensors(capture.test[0], loaded.scales, "cpu").views
        with torch.no_grad():
            loaded.model.render(views, sh_degree=loaded.sh_degree)
    except UserError as error:
        errors.append(error)
    try:
        Trainer.resume(CONFIG, capture, RunDirectory.open(run)).train_step()
    except UserError as error:
        errors.append(error)
    for error in errors:
        assert error.message.strip()
        assert "weights_only" not in error.message + error.hint
        assert len(error.message) < 1000


@pytest.mark.rotating("fuzzed input")
def test_fuzzed_checkpoints(original: Path, capture: Capture, tmp_path: Path) -> None:
    """Every case is used as thermosplat-render and --resume do; bytes that were damaged never become other content."""
    content, before = original.read_bytes(), values_of(original)
    refused, failed = 0, []
    Path("/proc/self/clear_refs").write_text("5")  # the most memory until now, of whatever test, is forgotten
    at_rest = memory("VmRSS")
    for case in range(CASES):
        chance = random.Random(case)
        run = tmp_path / f"case{case}"
        path = run / "ckpts" / original.name
        path.parent.mkdir(parents=True)
        damage = chance.choice(BYTES) if case % 2 else None
        path.write_bytes(content if damage is None else damage(content, chance))
        if damage is None:
            chance.choice(EDITS)(path, chance)
        started = time.process_time()
        try:
            if damage is None:
                used(run, capture)
            else:
                refused += not unchanged_or_refused(path, before, run)
        except Exception as error:
            failed.append(f"case {case}: {type(error).__name__}: {error}")
        if time.process_time() - started > LIMIT_SECONDS:
            failed.append(f"case {case}: {time.process_time() - started:.1f} s")
        shutil.rmtree(run)
        if case % 200 == 199:
            print(f"{case + 1} cases, failed: {failed}", flush=True)
    assert not failed
    assert refused > 0.4 * (CASES // 2)
    assert memory("VmHWM") - at_rest < LIMIT_BYTES


def memory(kind: str) -> int:
    """Bytes of this process: VmRSS, what it has now, or VmHWM, the most that it had."""
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(f"{kind}:"))
    return 1024 * int(line.split()[1])


def unchanged_or_refused(path: Path, before: dict[str, torch.Tensor], run: Path) -> bool:
    """Whether a damaged file could be read; its content is then that of the whole one."""
    try:
        load_run(str(run), device="cpu")
    except UserError as error:
        if "damaged" not in error.message:
            raise AssertionError(error.message) from error
        return False
    now = values_of(path)
    assert now.keys() == before.keys()
    assert all(torch.equal(now[name], before[name]) for name in before)
    return True
