"""Decoders are swapped for the time of a step, and give the same images."""

import pytest
import torch

from thermosplat.config import DecoderConfig
from thermosplat.decoders import Decoders
from thermosplat.training import fast_decoders
from thermosplat.training.fast_decoders import BRANCHES, FastDecoders, can_compile


def test_precision_and_branches_are_put_back() -> None:
    """Inside: compiled branches and TF32; afterwards, also after an error, everything is as before."""
    decoders = Decoders(DecoderConfig(hidden_dim=4), 4, 3)
    before = torch.get_float32_matmul_precision()
    fast = FastDecoders(decoders, compiled=True, tf32=True)

    def fail() -> None:
        with fast.active():
            assert torch.get_float32_matmul_precision() == "high"
            assert all(name in vars(decoders) for name in BRANCHES)
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        fail()
    assert torch.get_float32_matmul_precision() == before
    assert not any(name in vars(decoders) for name in BRANCHES)


def test_plain_decoders_stay() -> None:
    """Nothing to compile, full precision: nothing is touched."""
    decoders = Decoders(DecoderConfig(hidden_dim=4), 4, 3)
    with FastDecoders(decoders, compiled=False, tf32=False).active():
        assert torch.get_float32_matmul_precision() == "highest"
        assert not any(name in vars(decoders) for name in BRANCHES)


def test_compiling_needs_triton_and_a_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without either, training goes on with plain PyTorch."""
    monkeypatch.setattr(fast_decoders.importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(fast_decoders.shutil, "which", lambda name: "/usr/bin/cc")
    assert can_compile()
    monkeypatch.setattr(fast_decoders.shutil, "which", lambda name: None)
    assert not can_compile()
    monkeypatch.setattr(fast_decoders.shutil, "which", lambda name: "/usr/bin/cc")
    monkeypatch.setattr(fast_decoders.importlib.util, "find_spec", lambda name: None)
    assert not can_compile()


@pytest.mark.cuda
def test_compiled_decoders_give_the_same_images() -> None:
    """Images and gradients of compiled branches equal the plain ones' to float32 rounding."""
    if not (torch.cuda.is_available() and can_compile()):
        pytest.skip("needs a CUDA device and Triton")
    decoders = Decoders(DecoderConfig(), 8, 3).cuda()
    features = torch.randn(2, 20, 30, 8, device="cuda")
    results = []
    for compiled in (False, True):
        leaf = features.clone().requires_grad_()
        with FastDecoders(decoders, compiled=compiled, tf32=False).active():
            images = decoders.both(leaf[0], leaf[1])
        sum(image.square().sum() for image in images).backward()
        results.append([*(image.detach() for image in images), leaf.grad])
    for plain, fast in zip(*results, strict=True):
        torch.testing.assert_close(fast, plain, rtol=1e-4, atol=1e-5)
