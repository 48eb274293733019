"""The one error class for mistakes a user can mend."""


class UserError(ValueError):
    """A mistake in what the user gave: input files, flags, configuration or tensors.

    Commands print it as a panel and exit with code 2; library callers catch it as a ``ValueError``.

    Args:
        message: One sentence or two: what was expected, what was found, where.
        hint: What to do about it, preferably the very command or flag.

    Attributes:
        message: As given; ``str(error)`` is message and hint together.
        hint: As given, "" where there is none.
    """

    def __init__(self, message: str, hint: str = "") -> None:
        super().__init__(message if not hint else f"{message} {hint}")
        self.message = message
        self.hint = hint
