"""What is printed: it cannot command the terminal, and it never ends a command.

The names of files come from strangers and reach most of what is said. So nothing is left to the places that say
something: a command prints through ``safe_output``, which stands before standard output and standard error. Control
characters, marks that turn the direction of writing, and bytes that are no UTF-8 are printed as escapes. What cannot be
written, because a disk is full or nobody reads it, is lost, and the command goes on. ``SafeConsole`` does the same to
what rich lays out.
"""

import errno
import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from typing import IO, Any, TextIO

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment


def printable(text: str, *, lines: bool = False) -> str:
    r"""A text without what a terminal would act upon: ``\x1b`` in place of the character that begins its commands.

    Args:
        text: Any text; surrogates stand for the bytes of a file name that is no UTF-8, as Python has them.
        lines: Keep the ends of lines.
    """
    if text.isprintable():
        return text
    return "".join(sign if sign.isprintable() or (lines and sign == "\n") else _escape(sign) for sign in text)


def _escape(sign: str) -> str:
    if "\udc80" <= sign <= "\udcff":
        return f"\\x{ord(sign) - 0xDC00:02x}"
    return sign.encode("unicode_escape").decode()


class _Output:
    """Standard output or error as a command has it.

    Args:
        lines: Whether a text that is written may have several lines. One of print() may not: a name could have them.
    """

    def __init__(self, stream: TextIO, *, lines: bool) -> None:
        self.stream = stream
        self.lines = lines
        self.lost = False
        """Whether something could not be written."""
        self.told = False
        """Whether that has been said."""
        self.may_end = False
        """Whether a reader who leaves early, as of ``--help | head``, has had what it wanted."""

    def write(self, text: str) -> int:
        """Write what can be written of a text, escaped."""
        end = len(text.rstrip("\n"))
        return self.pass_on(printable(text[:end], lines=self.lines) + text[end:])

    def pass_on(self, text: str) -> int:
        """Write what can be written of a text, as it is."""
        try:
            self.stream.write(text)
        except OSError as error:
            self._lose(error)
        return len(text)

    def flush(self) -> None:
        """Let go of what is held back."""
        try:
            self.stream.flush()
        except OSError as error:
            self._lose(error)

    def end(self) -> None:
        """Let go of what is held back for the last time. Python would fail when it tries again at its own end."""
        try:
            self.stream.flush()
        except OSError as error:
            if error.errno != errno.EPIPE:  # | head has had what it wanted
                self._lose(error)
            with suppress(OSError, ValueError):  # no file behind it
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, self.stream.fileno())
                os.close(nowhere)

    def _lose(self, error: OSError) -> None:
        self.lost = True
        if not self.told and not (self.may_end and error.errno == errno.EPIPE):
            self.told = True
            print(f"The output cannot be written ({error.strerror}). The command goes on.", file=sys.stderr, flush=True)

    @property
    def rich_proxied_file(self) -> "_Unescaped":
        """Where rich writes."""
        return _Unescaped(self)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


class _Unescaped:
    """An output for those who have made their texts safe and add colours."""

    def __init__(self, output: _Output) -> None:
        self._output = output

    def write(self, text: str) -> int:
        """Write what can be written of a text, as it is."""
        return self._output.pass_on(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._output, name)


@contextmanager
def safe_output() -> Iterator[None]:
    """Around a command: what it prints is safe and ends nothing. Blocks inside it change nothing."""
    if isinstance(sys.stdout, _Output) or isinstance(sys.stderr, _Output):
        yield
        return
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:  # closed by whoever started this: the next file that is opened would be it
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115  until the end
    outputs = _Output(sys.stdout, lines=False), _Output(sys.stderr, lines=True)
    for output in outputs:
        # "surrogateescape" is what Python takes where LANG=C
        if hasattr(output.stream, "reconfigure") and output.stream.errors in ("strict", "surrogateescape"):
            output.stream.reconfigure(errors="backslashreplace")  # signs that the terminal lacks
    with redirect_stdout(outputs[0]), redirect_stderr(outputs[1]):
        try:
            yield
        finally:
            for output in outputs:
                output.end()


@contextmanager
def help_printed(words: Iterable[str]) -> Iterator[None]:
    """Around a library that prints help in colours and lines; it repeats words, which are escaped if they need it."""
    output, errors = sys.stdout, sys.stderr
    if not (isinstance(output, _Output) and isinstance(errors, _Output)):
        yield
        return
    output.lines = output.may_end = True
    colored = all(map(str.isprintable, words))
    with (
        redirect_stdout(output.rich_proxied_file if colored else output),
        redirect_stderr(errors.rich_proxied_file if colored else errors),
    ):
        yield
    output.lines = output.may_end = False


def print_last(*lines: str) -> None:
    """Print the last lines of a command, on standard error if standard output cannot be written."""
    for stream in (sys.stdout, sys.stderr):
        for line in lines:
            print(line, file=stream, flush=True)
        if not getattr(stream, "lost", False):
            return


class SafeConsole(Console):
    """A console of rich whose texts cannot command the terminal, and which cannot fail; see the file's head."""

    _own: _Output | None = None

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """As of rich, with what would command the terminal as escapes."""
        for segment in super().render(renderable, options):
            text = segment.text if segment.control else printable(segment.text, lines=True)
            yield Segment(text, segment.style, segment.control)

    @property
    def file(self) -> IO[str]:
        """Where it prints: standard output or error of the moment, unescaped, if no other file was given."""
        found: Any = Console.file.fget(self)  # type: ignore[attr-defined]
        if not hasattr(found, "rich_proxied_file"):  # outside of a command
            if self._own is None or self._own.stream is not found:
                self._own = _Output(found, lines=True)
            found = self._own
        return found.rich_proxied_file

    @file.setter
    def file(self, new_file: IO[str]) -> None:
        Console.file.fset(self, new_file)  # type: ignore[attr-defined]
