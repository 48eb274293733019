"""Images that are decoded some rows at a time are the images."""

from collections.abc import Mapping

import pytest
import torch
from torch import Tensor

from thermosplat.config import DecoderConfig
from thermosplat.scene import decoder as decoder_module
from thermosplat.scene.decoder import decode_in_parts
from thermosplat.scene.formations.kinds import make_decoder
from toy_scene import toy_capture, toy_config, toy_model


@pytest.mark.parametrize("branches", ["joined", "separate"])
def test_parts_are_the_image(branches: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of all spectra, of any number of rows; with gradients it is decoded in one piece."""
    spectra = list(toy_model(toy_config(), toy_capture()).spectra.values())
    decoder = make_decoder(DecoderConfig(branches=branches), 8, spectra)  # type: ignore[arg-type]
    inputs = {spectrum.name: torch.randn(13, 7, 8) for spectrum in spectra}
    heights: list[int] = []

    def decode(some: Mapping[str, Tensor]) -> dict[str, Tensor]:
        heights.append(len(some["rgb"]))
        return decoder.decode(some)

    monkeypatch.setattr(decoder_module, "PIXELS_AT_ONCE", 4 * 7 + 3)
    whole = decode_in_parts(decode, inputs)
    with torch.no_grad():
        parts = decode_in_parts(decode, inputs)
    assert heights == [13, 4, 4, 4, 1]
    for name, image in whole.items():
        assert image.requires_grad
        torch.testing.assert_close(parts[name], image, rtol=1e-6, atol=1e-6)
