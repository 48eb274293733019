"""tests/fixtures/README.md: every module that tests share has its place there."""

import re

from repository_documents import REPOSITORY

FIXTURES = REPOSITORY / "tests" / "fixtures"


def test_every_shared_module_is_listed_once() -> None:
    """Those that are there and no others; tests of the shared modules themselves need no place."""
    listed = re.findall(r"`(\w+\.py)`", (FIXTURES / "README.md").read_text(encoding="utf-8").split("\n\n", 2)[2])
    there = {path.name for path in FIXTURES.glob("*.py") if not path.name.startswith("test_")}
    assert sorted(listed) == sorted(there)
