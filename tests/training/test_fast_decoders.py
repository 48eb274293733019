"""Decoders are swapped for the time of a step, and give the same images."""

import pytest
import torch

from thermosplat.config import DecoderConfig, ModelConfig, TrainConfig
from thermosplat.scene.decoder import Decoders
from thermosplat.scene.formations.scene_formations import Formations
from thermosplat.spectra import Spectrum
from thermosplat.training import fast_decoders
from thermosplat.training.fast_decoders import FastDecoders, can_compile

SPECTRA = (
    Spectrum("rgb", 3, "photograph", "shared", (0, 3), "thermal"),
    Spectrum("thermal", 3, "color", "offset", (3, 4), None),
    Spectrum("nir", 1, "scalar", "shared", (4, 5), None),
)


def named(features: torch.Tensor) -> dict[str, torch.Tensor]:
    """Features of each spectrum by its name."""
    return {spectrum.name: of_one for spectrum, of_one in zip(SPECTRA, features, strict=True)}


def test_precision_and_decoding_are_put_back() -> None:
    """Inside: compiled decoding and TF32; afterwards, also after an error, everything is as before."""
    formations = Formations(ModelConfig(feature_dim=5), DecoderConfig(hidden_dim=4), SPECTRA)
    before, plain = torch.get_float32_matmul_precision(), formations.decode
    fast = FastDecoders(formations.decoder, compiled=True, precision="tf32")

    def fail() -> None:
        with fast.active(formations):
            assert torch.get_float32_matmul_precision() == "high"
            assert formations.decode is fast.decode
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        fail()
    assert torch.get_float32_matmul_precision() == before
    assert formations.decode is plain


def test_images_and_gradients() -> None:
    """The images of plain decoders; gradients reach features and weights. On the CPU they are the plain ones."""
    decoders = Decoders(DecoderConfig(hidden_dim=16), 8, SPECTRA)
    features = torch.rand(3, 7, 9, 8, generator=torch.Generator().manual_seed(0))
    leaf = features.clone().requires_grad_()
    fast = FastDecoders(decoders, compiled=False, precision="float32")
    with fast.precise():
        images = fast.decode(named(leaf))
        alone = fast.decode({"rgb": leaf[0]})
    plain = decoders.decode(named(features))
    assert list(images) == ["rgb", "thermal", "nir"]
    for name, image in (*images.items(), *alone.items()):
        assert image.dtype == torch.float32
        assert (image - plain[name]).abs().max() < 2.0**-20
    sum(image.sum() for image in images.values()).backward()
    assert leaf.grad.dtype == torch.float32
    assert all(parameter.grad.abs().sum() > 0 for parameter in decoders.parameters())
    formations = Formations(ModelConfig(feature_dim=8), DecoderConfig(hidden_dim=4), SPECTRA)
    on_cpu = fast_decoders.fast_decoding(formations, TrainConfig(decoder_precision="tf32"), torch.device("cpu"))
    with on_cpu():
        assert formations.decode == formations.decoder.decode


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
    """Images and gradients of compiled decoding equal the plain ones' to float32 rounding."""
    if not can_compile():
        pytest.skip("needs Triton and a C compiler")
    decoders = Decoders(DecoderConfig(), 8, SPECTRA).cuda()
    features = torch.randn(3, 20, 30, 8, device="cuda")
    results = []
    for compiled in (False, True):
        leaf = features.clone().requires_grad_()
        fast = FastDecoders(decoders, compiled=compiled, precision="float32")
        with fast.precise():
            images = fast.decode(named(leaf))
        sum(image.square().sum() for image in images.values()).backward()
        results.append([*(image.detach() for image in images.values()), leaf.grad])
    for plain, fast in zip(*results, strict=True):
        torch.testing.assert_close(fast, plain, rtol=1e-4, atol=1e-5)
