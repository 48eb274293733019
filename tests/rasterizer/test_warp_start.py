"""Warp is started, and kernels of a step are compiled, while images are read."""

import errno
from dataclasses import replace
from typing import Any

import pytest

from thermosplat.config import TrainConfig
from thermosplat.config.files import from_dict
from thermosplat.errors import UserError
from thermosplat.rasterizer import warp_start
from thermosplat.rasterizer.warp_start import started_meanwhile
from warp_kernels import step_kernels


def test_a_cache_that_cannot_be_written_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """The message names the folder, and the variable that names another."""

    def refuse() -> None:
        raise PermissionError(errno.EACCES, "Permission denied", "/home/me/.cache/warp")

    monkeypatch.setattr(warp_start.wp, "init", refuse)
    with pytest.raises(UserError, match=r"Permission denied \(/home/me/\.cache/warp\)") as caught:
        warp_start.start_warp()
    assert "WARP_CACHE_PATH" in caught.value.hint


def test_a_start_that_fails_beside_other_work_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """The work is done first; an error of its own goes before."""

    def refuse() -> None:
        raise PermissionError(errno.EACCES, "Permission denied", "/home/me/.cache/warp")

    monkeypatch.setattr(warp_start.wp, "init", refuse)
    done = []
    with pytest.raises(UserError, match="Permission denied"), started_meanwhile(TrainConfig()):
        done.append(True)
    assert done
    with pytest.raises(ZeroDivisionError), started_meanwhile(TrainConfig()):
        raise ZeroDivisionError


@pytest.mark.parametrize(
    ("changes", "kernels"),
    [
        ({}, [(11, 8)]),
        ({"spectra": {"thermal": {"opacity": "shared"}}}, [(11, 0)]),
        ({"model": {"gaussian_sets": "separate", "feature_dim": 0}}, []),
        ({"device": "cuda"}, []),
    ],
)
def test_kernels_are_compiled_before_the_block_ends(
    changes: dict, kernels: list, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of the configuration's step, on the CPU, where both spectra share their Gaussians."""
    compiled: list[Any] = []
    monkeypatch.setattr(step_kernels, "cpu_step_kernels", lambda *shape: shape)
    monkeypatch.setattr(step_kernels, "must_compile_for_cpu", lambda shape: False)
    monkeypatch.setattr(step_kernels, "compile_for_cpu", lambda shape: compiled.append(shape))
    with started_meanwhile(from_dict({"device": "cpu"} | changes)):
        pass
    assert compiled == kernels


def test_errors_of_the_compiler_are_not_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """They come when the kernels would be needed."""

    def fail(*_: Any) -> None:
        raise RuntimeError("no compiler")

    monkeypatch.setattr(step_kernels, "compile_for_cpu", fail)
    with pytest.raises(RuntimeError, match="no compiler"), started_meanwhile(replace(TrainConfig(), device="cpu")):
        pass


@pytest.mark.parametrize("cached", [True, False])
def test_compiling_is_said_before_it_begins(
    cached: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A start that takes half a minute says why at once; one that finds all kernels in the cache says nothing."""
    said: list[str] = []
    monkeypatch.setattr(step_kernels, "must_compile_for_cpu", lambda kernels: not cached)
    monkeypatch.setattr(step_kernels, "compile_for_cpu", lambda kernels: said.append(capsys.readouterr().out))
    with started_meanwhile(replace(TrainConfig(), device="cpu")):
        pass
    assert [text.startswith("Compiling kernels, once per machine") for text in said] == [not cached]
