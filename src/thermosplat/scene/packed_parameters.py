"""Parameters of Gaussians without what is zero: spherical harmonics to each one's own degree, offsets that count.

Training keeps dense float32 tensors; checkpoints hold these. Where all numbers of a tensor are ones that float16 has,
they are stored as such. Every packed tensor unpacks to an equal one, and what would not shrink stays as it is.
"""

import torch
from torch import Tensor

from thermosplat.scene.gaussians import OFFSETS


def pack(parameters: dict[str, Tensor]) -> dict[str, Tensor]:
    """A set's parameters as they are stored.

    ``<name>`` of higher degrees [N, K-1, 3] becomes ``<name>.degrees`` (uint8 [N], the highest degree with a
    coefficient that is not zero) and ``<name>.values`` (all coefficients up to it, [M, 3]); opacity offsets [N]
    become ``<name>.kept`` (bool [N]) and ``<name>.values`` ([M]).

    Args:
        parameters: As ``Gaussians.state_dict`` gives them.
    """
    packed: dict[str, Tensor] = {}
    for name, value in parameters.items():
        parts = {}
        if is_band(name) and value.numel() > 0:
            degrees = sh_degrees(value)
            parts = {f"{name}.degrees": degrees, f"{name}.values": value[_within(degrees, value.shape[1])]}
        elif name.endswith(OFFSETS):
            parts = {f"{name}.kept": value != 0, f"{name}.values": value[value != 0]}
        packed |= parts if parts and num_bytes(parts) < num_bytes({name: value}) else {name: value}
    return {name: _halved(value) for name, value in packed.items()}


def unpack(packed: dict[str, Tensor], num_bases: int) -> dict[str, Tensor]:
    """The inverse of ``pack``.

    Args:
        packed: What ``pack`` returned.
        num_bases: Spherical harmonics above degree 0, K - 1.
    """
    packed = {name: value.float() if value.dtype == torch.float16 else value for name, value in packed.items()}
    parameters: dict[str, Tensor] = {}
    for name in dict.fromkeys(key.partition(".")[0] for key in packed):  # in their order, which a set would not keep
        if name in packed:
            parameters[name] = packed[name]
            continue
        values = packed[f"{name}.values"]
        if is_band(name):
            degrees = packed[f"{name}.degrees"]
            dense = values.new_zeros(len(degrees), num_bases, 3)
            dense[_within(degrees, num_bases)] = values
        else:
            kept = packed[f"{name}.kept"]
            dense = values.new_zeros(len(kept))
            dense[kept] = values
        parameters[name] = dense
    return parameters


def num_bytes(parameters: dict[str, Tensor]) -> int:
    """Bytes of tensors by name."""
    return sum(value.numel() * value.element_size() for value in parameters.values())


def sh_degrees(shN: Tensor) -> Tensor:
    """Highest degree with a coefficient that is not zero, uint8 [N], of coefficients [N, K-1, 3]."""
    used = (shN != 0).any(dim=-1)  # [N, K-1]
    degrees = torch.tensor([_degree(base) for base in range(shN.shape[1])], device=shN.device, dtype=torch.uint8)
    return (used * degrees).amax(dim=1)


def is_band(name: str) -> bool:
    """Whether a parameter holds the higher degrees of a spectrum's spherical harmonics."""
    return name == "shN" or name.endswith("_shN")


def _halved(value: Tensor) -> Tensor:
    """The same numbers as float16 where that has them all."""
    if value.dtype != torch.float32:
        return value
    half = value.half()
    return half if torch.equal(half.float(), value) else value


def _degree(base: int) -> int:
    """Degree of the base of this index above degree 0: 0 to 2 have degree 1, 3 to 7 degree 2, 8 to 14 degree 3."""
    degree = 1
    while base >= (degree + 1) ** 2 - 1:
        degree += 1
    return degree


def _within(degrees: Tensor, num_bases: int) -> Tensor:
    """Mask [N, K-1] of the coefficients up to each one's degree."""
    counts = (degrees.long() + 1) ** 2 - 1
    return torch.arange(num_bases, device=degrees.device) < counts[:, None]
