"""Starting Warp without the warning that its native library prints on every machine without an NVIDIA driver."""

import os
import sys
import tempfile

import warp as wp

EXPECTED_WITHOUT_CUDA = b"Could not find or load the NVIDIA CUDA driver"


def start_warp() -> None:
    """Initialise Warp. The commands say themselves that there is no CUDA device; everything else it prints stays.

    The warning comes from C and is written to the file descriptor, where Python cannot filter it: standard error goes
    through a file meanwhile.
    """
    wp.config.log_level = wp.LOG_WARNING  # no banner with versions and devices
    sys.stderr.flush()
    saved = os.dup(2)
    with tempfile.TemporaryFile() as printed:
        try:
            os.dup2(printed.fileno(), 2)
            wp.init()
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            printed.seek(0)
            for line in printed:
                if EXPECTED_WITHOUT_CUDA not in line:
                    os.write(2, line)
