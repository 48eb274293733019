"""What is recorded on a tape, and which gradients an adjoint is given."""

import warp as wp

from warp_kernels.machinery.tape_recording import gradient_of, record_adjoint


def test_gradient_of_an_array_is_its_own() -> None:
    """An adjoint adds to the memory the user reads."""
    array = wp.zeros(3, dtype=wp.vec2, device="cpu", requires_grad=True)
    assert gradient_of(array) is array.grad


def test_gradient_nobody_wants() -> None:
    """Zeros of the array's shape and type, which do not become its gradient."""
    array = wp.full((3, 2), wp.vec2(1.0, 2.0), dtype=wp.vec2, device="cpu")
    gradient = gradient_of(array)
    assert (gradient.shape, gradient.dtype) == (array.shape, array.dtype)
    assert (gradient.numpy() == 0).all()
    assert array.grad is None


def test_backward_runs_adjoints_in_reverse_and_zero_clears_recorded_gradients() -> None:
    """Arrays without a gradient are recorded as none."""
    wanted = wp.zeros(2, dtype=float, device="cpu", requires_grad=True)
    unwanted = wp.zeros(2, dtype=float, device="cpu")
    tape, order = wp.Tape(), []
    record_adjoint(tape, lambda: order.append("first step"), wanted, unwanted)
    record_adjoint(tape, lambda: order.append("second step"), unwanted)
    tape.backward()
    assert order == ["second step", "first step"]
    wanted.grad.fill_(5.0)
    tape.zero()
    assert (wanted.grad.numpy() == 0).all()
    assert unwanted.grad is None
