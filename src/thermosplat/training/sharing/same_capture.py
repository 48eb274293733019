"""Whether all ranks have read the same capture: on several hosts each reads its own copy."""

import hashlib
import socket

import numpy as np

from thermosplat import __version__
from thermosplat.datasets.capture import Capture, View
from thermosplat.distributed.team import Team
from thermosplat.errors import UserError


def check_same_capture(team: Team, capture: Capture) -> None:
    """Compare this rank's capture with rank 0's.

    Raises:
        UserError: On the first rank whose capture is another one: names what differs, and both hosts.
        EndedElsewhere: On the others.
    """
    host = socket.gethostname()
    first_host, first = team.object_of_first((host, capture_digests(capture)) if team.is_first else None)

    def compare() -> None:
        own = capture_digests(capture)
        different = [name for name in dict.fromkeys([*first, *own]) if first.get(name) != own.get(name)]
        if different:
            more = f", and {len(different) - 1:,} more" if len(different) > 1 else ""
            raise UserError(
                f"The ranks have read different captures: {different[0]}{more} of rank {team.rank} on {host} "
                f"({capture.root}) is not that of rank 0 on {first_host}.",
                "Copy the capture anew to every host, or put it on a disk that all hosts share.",
            )

    team.done_by_all(compare)


def capture_digests(capture: Capture) -> dict[str, str]:
    """What a training reads of a capture, by what it is called: short digests.

    Of images that stay on the disk it is the size of their files: to read all of them would take long.
    """
    digests = {
        "the version of thermosplat": __version__,
        "the place of the images, in memory or (beyond --image-memory) on the disk,": str(capture.on_disk is None),
        "the list of frames": _digest(repr([[frame.name for frame in part] for part in (capture.train, capture.test)])),
        "the sparse points": _digest(capture.points, capture.point_colors),
        "the meaning of pixel values": _digest(
            repr([(name, scale.state_dict()) for name, scale in sorted(capture.scales.items())])
        ),
    }
    for part, frames in (("training", capture.train), ("held-out", capture.test)):
        for frame in frames:
            for spectrum, view in frame.views.items():
                digests[f"the {spectrum} view of the {part} frame {frame.name}, {view.path.name},"] = _of_view(view)
    return digests


def _of_view(view: View) -> str:
    camera = repr((view.camera, None if view.readout is None else (view.readout.order, view.readout.motion.tobytes())))
    if view.stored is not None:
        return _digest(view.viewmat, camera, repr((view.stored.header, [stamp.size for stamp in view.stored.stamps])))
    pixels = view.pixels()
    others = [part for part in (pixels.values, pixels.mask) if part is not None]
    return _digest(view.viewmat, pixels.image, *others, camera)


def _digest(*parts: "np.ndarray | str") -> str:
    found = hashlib.blake2b(digest_size=8)
    for part in parts:
        if isinstance(part, str):
            found.update(part.encode(errors="backslashreplace"))
        else:
            found.update(f"{part.shape} {part.dtype}".encode())
            found.update(np.ascontiguousarray(part).data)
    return found.hexdigest()
