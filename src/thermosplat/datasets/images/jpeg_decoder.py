"""Decodes the JPEG files that the standard input names (jpeg_warnings.py starts it); libjpeg warns on standard error.

A zero byte on the standard error goes before each file and after the last, so that a warning has its file.
"""

import contextlib
import os
import sys

import cv2
import numpy as np


def main() -> None:
    """Decode all files. What cannot be decoded at all is nothing to warn of: whoever reads it will see."""
    for name in sys.stdin.buffer.read().split(b"\0"):
        os.write(2, b"\0")
        with contextlib.suppress(OSError, cv2.error):
            cv2.imdecode(np.fromfile(os.fsdecode(name), np.uint8), cv2.IMREAD_REDUCED_GRAYSCALE_8)
    os.write(2, b"\0")


if __name__ == "__main__":
    main()
