"""How a command ends: exit codes, the panel, and what --debug adds."""

import errno
import os
import signal

import pytest
import torch

from thermosplat.cli.errors import run_command
from thermosplat.errors import UserError

pytestmark = pytest.mark.usefixtures("stoppable")


def failing(error: BaseException):
    def body() -> int:
        raise error

    return body


def test_success_passes_its_code_on() -> None:
    """The body's exit code is the command's."""
    assert run_command(lambda: 0, debug=False) == 0
    assert run_command(lambda: 130, debug=False) == 130


def test_user_error_is_a_panel_on_stderr(capsys: pytest.CaptureFixture[str]) -> None:
    """Message and hint, literally even where they look like markup, on stderr; code 2; no traceback."""
    assert run_command(failing(UserError("No [bold] here.", "Use --this.")), debug=False) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "No [bold] here." in captured.err
    assert "Use --this." in captured.err
    assert "Traceback" not in captured.err


def test_user_error_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    """For the logs that thermosplat-benchmark reads."""
    assert run_command(failing(UserError("No\n" + 100 * "x" + ".", "Use this.")), debug=False, one_line=True) == 2
    assert capsys.readouterr().err == f"Error: No {100 * 'x'}. Use this.\n"


def test_debug_shows_the_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    """--debug adds the traceback and keeps the code."""
    assert run_command(failing(UserError("No.")), debug=True) == 2
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize("number", [errno.EACCES, errno.ENAMETOOLONG, errno.ELOOP, errno.EROFS, errno.ENOSPC])
def test_what_the_system_refuses_is_a_sentence(number: int, capsys: pytest.CaptureFixture[str]) -> None:
    """The path, what the system says of it, and what helps; a long path is cut."""
    assert run_command(failing(OSError(number, os.strerror(number), "p" * 500)), debug=False, one_line=True) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"Error: {'p' * 120}... (500 letters) cannot be used: {os.strerror(number)}. ")
    assert "Traceback" not in said


def test_other_errors_of_the_system_are_raised() -> None:
    """What no user can mend stays as it is, and so does everything with --debug."""
    for error, debug in ((OSError(errno.EBADF, "bad", "f"), False), (OSError(errno.EACCES, "no", "f"), True)):
        with pytest.raises(OSError, match=error.strerror or ""):
            run_command(failing(error), debug=debug)


def test_ctrl_c_is_130(capsys: pytest.CaptureFixture[str]) -> None:
    """Ctrl-C outside the training ends quietly with the shell's code for it."""
    assert run_command(failing(KeyboardInterrupt()), debug=False) == 130
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_stop_signals_have_the_shells_codes(number: signal.Signals, capsys: pytest.CaptureFixture[str]) -> None:
    """What Python would end at is an interrupt in a command, with the code a shell expects."""

    def body() -> int:
        os.kill(os.getpid(), number)
        return 0

    assert run_command(body, debug=False) == 128 + number
    assert "Interrupted." in capsys.readouterr().err


@pytest.mark.parametrize("one_line", [False, True])
def test_names_in_an_error_cannot_command_the_terminal(one_line: bool, capsys: pytest.CaptureFixture[str]) -> None:
    """Neither in the panel nor in a line, nor may they add lines of their own."""
    error = UserError("a\x1b[2J\nError: b.jpg is wrong.", "rm a\u202eb")
    assert run_command(failing(error), debug=False, one_line=one_line) == 2
    said = capsys.readouterr().err
    assert r"a\x1b[2J" + (" " if one_line else r"\n") + "Error: b.jpg is wrong." in said
    assert r"rm a\u202eb" in said
    assert not {"\x1b", "\u202e"} & set(said)


def caused(error: Exception, cause: Exception) -> Exception:
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    "error",
    [
        torch.OutOfMemoryError("CUDA out of memory"),
        MemoryError(),
        ImportError("cv2.abi3.so: failed to map segment from shared object"),
        OSError(errno.ENOMEM, os.strerror(errno.ENOMEM)),
        caused(RuntimeError("Failed to load the shared library"), OSError("warp.so: cannot allocate memory in block")),
        RuntimeError("can't start new thread"),
    ],
)
def test_out_of_memory_is_explained(error: BaseException, capsys: pytest.CaptureFixture[str]) -> None:
    """Running out of memory is the user's to mend, whoever says it in whatever words."""
    assert run_command(failing(error), debug=False) == 2
    assert "Out of memory" in capsys.readouterr().err


def test_bugs_stay_visible() -> None:
    """What is no mistake of the user's is not dressed up as one."""
    with pytest.raises(RuntimeError, match="a bug"):
        run_command(failing(RuntimeError("a bug")), debug=False)
