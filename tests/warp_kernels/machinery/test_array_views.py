"""Views are what Warp's own arrays are to a kernel."""

import numpy as np
import pytest
import warp as wp

from warp_kernels.machinery.array_views import ArrayView, contiguous_strides, empty, memory, nothing, zeros

CPU = "cpu"


def views(*arrays: wp.array) -> list[ArrayView]:
    """The same memory as views."""
    return [ArrayView(a.ptr, a.shape, a.dtype, a.device, a, None if a.is_contiguous else a.strides) for a in arrays]


@pytest.mark.parametrize("shape", [(7,), (0,), (3, 4), (2, 0), (2, 3, 4), (1, 2, 3, 4)])
@pytest.mark.parametrize("dtype", [wp.int32, wp.int64, wp.float64, wp.vec3, wp.mat44])
def test_a_view_is_packed_as_warp_packs(shape: tuple[int, ...], dtype: type) -> None:
    """Byte for byte what Warp passes to a kernel, and with the attributes of its arrays."""
    array = wp.zeros(shape, dtype=dtype, device=CPU)
    view = ArrayView(array.ptr or 0, shape, dtype, array.device)
    assert view.packed == bytes(array.__ctype__())
    for name in ("shape", "strides", "ndim", "size", "is_contiguous", "dtype"):
        assert getattr(view, name) == getattr(array, name), name
    assert len(view) == shape[0]


def test_strides_of_a_part() -> None:
    """A column of a matrix keeps the matrix's strides; rows of it begin further on."""
    whole = wp.array(np.arange(12, dtype=np.float32).reshape(4, 3), device=CPU)
    (column,) = views(whole[:, 1:2])
    assert column.packed == bytes(whole[:, 1:2].__ctype__())
    assert not column.is_contiguous
    assert contiguous_strides((4, 3), wp.float32) == (12, 4)
    (rows,) = views(whole)
    assert (rows[1:3].numpy() == whole.numpy()[1:3]).all()
    assert rows[1:3].owner is rows.owner is whole
    assert rows.release() is whole
    assert rows.owner is None


@pytest.mark.parametrize(
    ("shape", "strides"), [((2**31,), None), ((2, 2**29), None), ((3,), (2**31,)), ((3,), (-(2**31),))]
)
def test_what_32_bits_cannot_say_is_refused(shape: tuple[int, ...], strides: tuple[int, ...] | None) -> None:
    """An extent or a stride too large for a kernel is named, not left to the packing of bytes."""
    with pytest.raises(
        ValueError, match=r"shape \[.* bytes is too large for a kernel: .* at most 2,147,483,647"
    ) as raised:
        ArrayView(0, shape, wp.float32, wp.get_device(CPU), strides=strides)
    assert str(list(shape)) in str(raised.value)
    assert ArrayView(0, (2**31 - 1,), wp.float32, wp.get_device(CPU)).size == 2**31 - 1


def test_new_arrays_are_warps_own_unless_a_source_is_set() -> None:
    """Users of Warp alone get wp.array; who sets a source gets what that makes."""
    device = wp.get_device(CPU)
    assert isinstance(empty(3, wp.vec3, device), wp.array)
    array = zeros((2, 3), wp.int32, device)
    assert (array.numpy() == 0).all()
    array[0].fill_(7)
    assert memory.source.last(array[0]) == 7
    assert len(nothing(wp.vec2, 1, device)) == nothing(wp.vec2, 2, device).size == 0


def test_a_gradient_has_the_array_s_shape() -> None:
    """Its elements follow one another, whatever the array's own do."""
    column = wp.zeros((4, 3), dtype=wp.float32, device=CPU)[:, 1:2]
    memory_of_gradient = wp.zeros((4, 1), dtype=wp.float32, device=CPU)
    (view,) = views(column)
    view.gradient_at(memory_of_gradient.ptr, memory_of_gradient)
    assert view.grad.packed == bytes(memory_of_gradient.__ctype__())
    assert view.grad.owner is memory_of_gradient
