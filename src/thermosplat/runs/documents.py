"""JSON files of a run that people keep, edit and give to others: bookmarks, measurements."""

import json
from pathlib import Path
from typing import Any

from thermosplat.errors import UserError
from thermosplat.regular_files import read_regular

_LARGEST = 64 << 20
"""Bytes of a file that is read at all: some 160,000 bookmarks."""


def read_document(path: Path, what: str, version: int, hint: str) -> dict[str, Any]:
    """The object in a file, which says of itself that it is what is looked for.

    Args:
        what: What it holds, such as "bookmarks"; its "format" is "thermosplat-bookmarks".

    Raises:
        UserError: It cannot be read, or is something else.
    """
    try:
        if path.stat().st_size > _LARGEST:
            raise UserError(f"{path} is too large for a {what} file: more than {_LARGEST >> 20} MiB.", hint)
        content = json.loads(read_regular(path))
    except OSError as error:
        raise UserError(f"Cannot read the {what} {path}: {error.strerror or error}.", hint) from error
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path} is not a {what} file: it is no JSON.", hint) from error
    if not isinstance(content, dict) or content.get("format") != f"thermosplat-{what}":
        raise UserError(f'{path} is not a {what} file: it has no "format": "thermosplat-{what}".', hint)
    if content.get("version") != version:
        raise UserError(f"{path} has {what} of version {content.get('version')!r}, expected {version}.", hint)
    return content
