"""The colours that classes are shown in, and the classes that colours stand for.

They are PASCAL VOC's (Everingham et al. 2010): bit i of a number is bit 7 - i // 3 of channel i % 3. So each of 256
numbers has a colour of its own, and 8-bit colours say their numbers again. It works alike for arrays and tensors.
"""

from typing import Any

MOST_CLASSES = 255
UNLABELLED = 255
"""The number of pixels that belong to no class."""


def colors_of(numbers: Any) -> tuple[Any, Any, Any]:
    """Red, green and blue of classes, 0 to 255.

    Args:
        numbers: Integers from 0 to 255, of any shape.
    """
    red, green, blue = (
        sum((numbers >> bit & 1) << (7 - bit // 3) for bit in range(channel, 8, 3)) for channel in range(3)
    )
    return red, green, blue


def numbers_of(red: Any, green: Any, blue: Any) -> Any:
    """The classes of colours that ``colors_of`` gave.

    Args:
        red: Integers from 0 to 255, of any shape.
    """
    channels = (red, green, blue)
    return sum((channels[bit % 3] >> (7 - bit // 3) & 1) << bit for bit in range(8))
