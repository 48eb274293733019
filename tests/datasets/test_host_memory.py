"""How much memory there is for a process."""

import os
from pathlib import Path

import pytest

from thermosplat.datasets import host_memory
from thermosplat.datasets.host_memory import host_memory as found_memory


def test_a_container_may_have_less_than_its_host(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Control groups of either version; no limit is written as a word."""
    of_host = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    limit = tmp_path / "memory.max"
    monkeypatch.setattr(host_memory, "LIMITS", (limit, tmp_path / "none"))
    assert found_memory() == of_host
    limit.write_text("max\n")
    assert found_memory() == of_host
    limit.write_text(f"{2**20}\n")
    assert found_memory() == 2**20
