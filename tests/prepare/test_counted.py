"""Numbers in sentences."""

from thermosplat.prepare.counted import agreeing, counted


def test_words_agree_with_the_number() -> None:
    """One thing is singular, none and many are plural; large numbers are separated."""
    assert counted(1, "image") == "1 image"
    assert counted(0, "image") == "0 images"
    assert counted(12_345, "image has", "images have") == "12,345 images have"
    assert agreeing(1, "it is", "they are") == "it is"
    assert agreeing(2, "it is", "they are") == "they are"
