"""Tests of what measures, not of what is used: they have a part of their own."""

from pathlib import Path

import pytest


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Each is marked ``tooling``, before marks are chosen from."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker("tooling")
