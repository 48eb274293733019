"""What is zero is not stored, and comes back."""

import torch

from thermosplat.scene.packed_parameters import num_bytes, pack, sh_degrees, unpack


def parameters() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    shN = torch.randn(5, 15, 3, generator=generator)
    shN[0] = 0.0
    shN[1, 3:] = 0.0
    shN[2, 4:] = 0.0  # within degree 2
    shN[3] = 0.0
    offsets = torch.tensor([0.0, 0.0, 1.5, 0.0, 0.0])
    return {"means": torch.randn(5, 3), "shN": shN, "thermal_opacity_offsets": offsets}


def test_the_degree_in_use() -> None:
    """The degree of the highest coefficient that is not zero."""
    assert sh_degrees(parameters()["shN"]).tolist() == [0, 1, 2, 0, 3]


def test_packed_parameters_come_back_and_are_smaller() -> None:
    """Equal after packing and unpacking; only what is needed is stored."""
    values = parameters()
    packed = pack(values)
    assert packed["shN.values"].shape == (3 + 8 + 15, 3)
    assert packed["thermal_opacity_offsets.values"].tolist() == [1.5]
    assert num_bytes(packed) == 4 * 15 + 5 + 4 * 3 * 26 + 5 + 2  # 1.5 is a number that float16 has
    back = unpack(packed, 15)
    assert back.keys() == values.keys()
    for name, value in values.items():
        assert torch.equal(back[name], value), name


def test_order_is_kept() -> None:
    """Parameters come back in their order, packed ones among the others: a resumed model has its parameters' order."""
    values = parameters()
    for names in (["shN", "thermal_opacity_offsets", "means"], ["thermal_opacity_offsets", "means", "shN"]):
        assert list(unpack(pack({name: values[name] for name in names}), 15)) == names


def test_what_would_not_shrink_stays() -> None:
    """Full harmonics and offsets everywhere are stored as they are; without harmonics there is nothing to pack."""
    full = {"shN": torch.ones(4, 3, 3), "thermal_opacity_offsets": torch.ones(4)}
    assert pack(full).keys() == full.keys()
    assert pack({"shN": torch.zeros(4, 0, 3)}).keys() == {"shN"}


def test_numbers_that_float16_has_are_stored_as_such() -> None:
    """In half the bytes, alone or in packed parts, and they come back as float32; numbers it lacks do not change."""
    values = parameters()
    values["shN"] = values["shN"].half().float()
    packed = pack(values)
    assert packed["shN.values"].dtype == packed["thermal_opacity_offsets.values"].dtype == torch.float16
    assert packed["means"].dtype == torch.float32
    back = unpack(packed, 15)
    for name, value in values.items():
        assert back[name].dtype == torch.float32
        assert torch.equal(back[name], value), name
    assert pack({"means": torch.tensor([[1e6, 0.0, 0.0]])})["means"].dtype == torch.float32
