"""Which spectra of a run a command shows."""

import pytest

from thermosplat.cli.run_arguments import SpectraArguments
from thermosplat.errors import UserError

TRAINED = ["rgb", "thermal", "red_edge"]


@pytest.mark.parametrize(
    ("asked", "shown"),
    [
        ((), TRAINED),
        (("thermal",), ["thermal"]),
        (("red_edge", "rgb"), ["rgb", "red_edge"]),
        (("rgb", "rgb"), ["rgb"]),
    ],
)
def test_spectra_are_shown_in_the_models_order(asked: tuple[str, ...], shown: list[str]) -> None:
    """All of them unless some are named, each once."""
    assert SpectraArguments(asked).chosen(TRAINED) == shown


def test_a_spectrum_that_was_not_trained() -> None:
    """The message says what was, the hint is the flag."""
    with pytest.raises(UserError) as caught:
        SpectraArguments(("rgb", "nir")).chosen(TRAINED)
    assert caught.value.message == "The run was trained on RGB, thermal and red edge images, not on NIR."
    assert caught.value.hint == "Give --spectra rgb thermal red_edge."
