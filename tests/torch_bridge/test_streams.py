"""Sharing a device: whose memory arrays lie in, and for how long."""

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
import warp as wp

from thermosplat.torch_bridge.streams import joined_capture, launches_on_torch_stream, on_torch_stream
from warp_kernels.machinery.array_views import ArrayView, empty, memory, zeros


def test_steps_allocate_from_torch(device: torch.device) -> None:
    """Inside, new arrays lie in torch tensors of the shape and type that stands for Warp's; outside they are Warp's."""
    with on_torch_stream(device) as warp_device:
        array = zeros((4, 5), wp.types.vector(3, wp.float64), warp_device)
        tensor = array.owner
        assert (tensor.shape, tensor.dtype, tensor.device.type) == ((4, 5, 3), torch.float64, device.type)
        assert tensor.data_ptr() == array.ptr
        assert tensor.abs().sum() == 0
        numbers = empty(6, wp.int64, warp_device)
        numbers.owner.fill_(3)
        assert memory.source.last(numbers) == 3
    assert isinstance(empty(6, wp.int64, warp_device), wp.array)


def test_entering_again_changes_nothing(device: torch.device) -> None:
    """Nested contexts of one stream are one; an error leaves it as any exit does."""
    before = memory.source
    with on_torch_stream(device):
        source = memory.source
        with pytest.raises(ZeroDivisionError), on_torch_stream(device):
            raise ZeroDivisionError
        assert memory.source is source
    assert memory.source is before


def test_launches_leave_warp_as_it_is(device: torch.device) -> None:
    """Arrays are torch's, and Warp's sorts still get their scopes inside."""
    before = memory.source
    with launches_on_torch_stream(device) as warp_device:
        array = empty(5, wp.float32, warp_device)
        assert isinstance(array, ArrayView)
        source = memory.source
        with on_torch_stream(device) as inner:
            assert inner is warp_device
            assert memory.source is source
    assert memory.source is before
    owner = array.release()
    assert owner.data_ptr() == array.ptr
    assert array.owner is None


def test_threads_have_contexts_of_their_own() -> None:
    """A thread that did not enter allocates from Warp."""
    with on_torch_stream(torch.device("cpu")) as warp_device, ThreadPoolExecutor(1) as pool:
        assert isinstance(pool.submit(empty, 3, wp.float32, warp_device).result(), wp.array)
        assert isinstance(empty(3, wp.float32, warp_device), ArrayView)


def test_nothing_is_captured_on_the_cpu() -> None:
    """There are no graphs of it."""
    with joined_capture(torch.device("cpu")) as captured:
        assert not captured


@pytest.mark.cuda
def test_arrays_follow_torchs_stream() -> None:
    """On a side stream the arrays and Warp's work are that stream's; afterwards the stream before is back."""
    device, side = torch.device("cuda"), torch.cuda.Stream()
    with on_torch_stream(device) as outer:
        first = outer.stream.cuda_stream
        with torch.cuda.stream(side), on_torch_stream(device) as inner:
            assert inner.stream.cuda_stream == side.cuda_stream
        assert outer.stream.cuda_stream == first == torch.cuda.current_stream().cuda_stream


@pytest.mark.cuda
def test_launches_go_to_the_stream_of_torch() -> None:
    """Without Warp's own current stream, which stays what it is until a sort or scan needs torch's."""
    device, side = torch.device("cuda"), torch.cuda.Stream()
    with torch.cuda.stream(side), launches_on_torch_stream(device) as warp_device:
        own = warp_device.stream
        assert own.cuda_stream != side.cuda_stream
        assert memory.source.stream.cuda_stream == side.cuda_stream
        with on_torch_stream(device):
            assert warp_device.stream.cuda_stream == side.cuda_stream
        assert warp_device.stream is own


@pytest.mark.cuda
def test_threads_take_turns() -> None:
    """Warp's stream is one for all threads, so a second thread waits until the first has left."""
    device, sides = torch.device("cuda"), [torch.cuda.Stream() for _ in range(2)]
    wanted, inside = threading.Event(), threading.Event()

    def second() -> int:
        with torch.cuda.stream(sides[1]):
            wanted.set()
            with on_torch_stream(device) as warp_device:
                inside.set()
                return warp_device.stream.cuda_stream

    with ThreadPoolExecutor(1) as pool:
        with torch.cuda.stream(sides[0]), on_torch_stream(device) as warp_device:
            other = pool.submit(second)
            assert wanted.wait(10)
            assert not inside.wait(0.2)
            assert warp_device.stream.cuda_stream == sides[0].cuda_stream
        assert other.result(10) == sides[1].cuda_stream
