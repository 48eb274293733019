"""Only regular files are read, and walks through folders end."""

import os
import socket
from pathlib import Path

import pytest

from thermosplat.regular_files import files_below, files_in, open_regular, read_regular


def special(path: Path, kind: str) -> None:
    """Something that is no file; a socket is bound by its bare name, since a socket's path must be short."""
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        here = Path.cwd()
        os.chdir(path.parent)
        try:
            socket.socket(socket.AF_UNIX).bind(path.name)
        finally:
            os.chdir(here)


@pytest.mark.parametrize("kind", ["pipe", "folder", "socket", "device"])
def test_what_is_no_file(tmp_path: Path, kind: str) -> None:
    """It is refused at once, and is not among the files of a folder."""
    special(tmp_path / "a.png", kind)
    (tmp_path / "link.png").symlink_to("a.png")
    for name in ("a.png", "link.png"):
        with pytest.raises(OSError, match=f"it is a {kind}, not a file"):
            open_regular(tmp_path / name)
    assert files_in(tmp_path) == files_below(tmp_path) == []


def test_files_and_links_to_them(tmp_path: Path) -> None:
    """They are read; a missing one, a link to nothing and a name that cannot be are errors of the system."""
    (tmp_path / "a").write_bytes(b"text")
    (tmp_path / "b").symlink_to("a")
    (tmp_path / "c").symlink_to("none")
    (tmp_path / "d").symlink_to("d")
    assert read_regular(tmp_path / "b") == b"text"
    assert files_in(tmp_path) == [tmp_path / "a", tmp_path / "b"]
    for name in ("c", "d", "none", "x" * 5000, "a\0b"):
        with pytest.raises(OSError):  # noqa: PT011  the system's own words
            open_regular(tmp_path / name)
    assert files_in(tmp_path / "none") == files_below(tmp_path / "none") == []


def test_links_to_folders(tmp_path: Path) -> None:
    """They are followed once; not in circles, not to folders above, not to the system's own."""
    for name in ("disk/a", "capture/rgb/b", "outside"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    inside = tmp_path / "capture" / "rgb"
    links = {"1": tmp_path / "disk", "2": inside, "3": tmp_path, "4": Path("/"), "5": Path("/proc"), "6": Path("/sys")}
    links["7"] = Path("/proc/self/task")
    for name, target in links.items():
        (inside / name).symlink_to(target)
    (tmp_path / "disk" / "back").symlink_to(inside)
    assert files_below(inside / "1") == [inside / "1" / "a", inside / "1" / "back" / "b"]
    assert [files_below(inside / name) for name in "34567"] == [[]] * 5
    assert files_below(tmp_path / "capture") == [inside / "1" / "a", inside / "b"]
