"""Words that agree with a number: 1 image has, 2 images have."""


def counted(number: int, one: str, many: str | None = None) -> str:
    """A number, with thousands separated, and the words for it.

    Args:
        one: The words for 1, such as "image" or "image has".
        many: The words for every other number; None: ``one`` with an s.
    """
    return f"{number:,} {agreeing(number, one, many or f'{one}s')}"


def agreeing(number: int, one: str, many: str) -> str:
    """The words for a number, without it: "has" for 1, "have" for others."""
    return one if number == 1 else many
