"""What a training says when it ends by a bad loss or a lost image."""

from pathlib import Path

from thermosplat.datasets.stored_pixels import ImageLostError
from thermosplat.training.session.safekeeping import image_lost_error, not_finite_error

RESUME = "thermosplat-train --resume results/shed"


def test_a_bad_loss_is_named_with_what_is_saved_and_how_to_go_on() -> None:
    """Step, term, where it was, the checkpoint, and the command."""
    saved = Path("ckpts/step_000411.pt")
    error = not_finite_error(1412, "rgb", "frame: 0007", "the pose of that frame", saved, RESUME)
    expected = "The loss became NaN or infinite at step 1,412 (term: rgb; frame: 0007). Last finite state saved to "
    assert error.message == f"{expected}{saved}."
    assert error.hint.startswith(f"Check the images and the pose of that frame, then go on with: {RESUME} Or start")


def test_a_lost_image_is_named_with_what_is_saved_and_how_to_go_on() -> None:
    """The reader's own sentence and hint, and the command; no hint leaves no gap."""
    lost = ImageLostError("Cannot read images/0007.jpg.", "Restore it.")
    error = image_lost_error(lost, "Checkpoint saved to ckpts/step_000411.pt.", RESUME)
    assert error.message == "Cannot read images/0007.jpg. Checkpoint saved to ckpts/step_000411.pt."
    assert error.hint == f"Restore it. Then go on with: {RESUME}"
    assert image_lost_error(ImageLostError("Gone."), "Saved.", RESUME).hint == f"Then go on with: {RESUME}"
