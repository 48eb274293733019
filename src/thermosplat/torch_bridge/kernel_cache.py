"""Starting Warp, and what a user is told where its folder for compiled kernels cannot be used."""

from thermosplat.errors import UserError
from warp_kernels.machinery.loading import KernelCacheError, start


def start_warp() -> None:
    """Initialises Warp, once.

    Raises:
        UserError: The folder for compiled kernels cannot be made, as where the home directory is read-only.
    """
    try:
        start()
    except KernelCacheError as error:
        raise cache_error(error) from error


def cache_error(error: KernelCacheError) -> UserError:
    """The same in a user's words."""
    return UserError(
        f"Warp cannot use its folder for compiled kernels: {error}.",
        "Name one that can be read and written: WARP_CACHE_PATH=FOLDER before the command.",
    )
