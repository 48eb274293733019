"""Errors that end a training, once what can be saved is saved. A full memory is in ``out_of_memory``."""

from thermosplat.datasets.stored_pixels import ImageLostError
from thermosplat.errors import UserError


def not_finite_error(step: int, term: str, where: str, suspects: str, saved: object, resume_command: str) -> UserError:
    """The error of a loss or gradient that is NaN or infinite.

    Args:
        step: The step that failed; its update was not made.
        term: The loss, or the tensor whose gradient it is.
        suspects: What to look at, after "Check the images and".
    """
    return UserError(
        f"The loss became NaN or infinite at step {step:,} (term: {term}; {where}). "
        f"Last finite state saved to {saved}.",
        f"Check the images and {suspects}, then go on with: {resume_command} "
        "Or start again with smaller learning rates (--optimizer.means-lr and the others).",
    )


def image_lost_error(lost: ImageLostError, saved: str, resume_command: str) -> UserError:
    """The error of an image that cannot be read any more.

    Args:
        lost: Which image, and what is to be done about it.
    """
    return UserError(f"{lost.message} {saved}", f"{lost.hint} Then go on with: {resume_command}".lstrip())
