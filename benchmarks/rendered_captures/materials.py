"""What surfaces do with light: Mitsuba's descriptions, with colours and images that are named later."""

from typing import Any, NamedTuple

from numpy.typing import NDArray

from rendered_captures.textures.noise import Color


class Painted(NamedTuple):
    """A colour or an image in sRGB where Mitsuba takes a texture."""

    color: Color | NDArray[Any]
    """Red, green and blue of 0 to 255, or an image [H, W, 3] whose row 0 is the top."""


def matte(color: Color | NDArray[Any]) -> dict[str, Any]:
    """A diffuse surface."""
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": Painted(color)}}


def gloss(color: Color | NDArray[Any]) -> dict[str, Any]:
    """A diffuse surface under a clear coat."""
    return {"type": "twosided", "bsdf": {"type": "plastic", "diffuse_reflectance": Painted(color), "int_ior": 1.5}}


def metal(kind: str = "Al", roughness: float = 0.0) -> dict[str, Any]:
    """A mirror, or where it is rough a brushed one."""
    if roughness == 0:
        return {"type": "twosided", "bsdf": {"type": "conductor", "material": kind}}
    return {"type": "twosided", "bsdf": {"type": "roughconductor", "material": kind, "alpha": roughness}}


def clear() -> dict[str, Any]:
    """Glass: a mirror of 9%, and 91% straight through. Volpath sends shadow rays through a mask."""
    mirror = {"type": "twosided", "bsdf": {"type": "conductor", "material": "none"}}
    return {"type": "mask", "opacity": 0.09, "nested": mirror}
