"""What a command line says of a flag, before tyro understands it."""


def last_value(words: list[str], flag: str) -> str | None:
    """The last value of a flag, given as the next word or after "="."""
    found = None
    for word, following in zip(words, [*words[1:], ""]):
        if word == flag:
            found = following
        elif word.startswith(f"{flag}="):
            found = word.removeprefix(f"{flag}=")
    return found
