"""Latent channels that training images do not need: found, left out, and not missed."""

import dataclasses
from typing import Any

import pytest
import torch
from torch import Tensor

from random_gaussians import stepped_optimizers
from thermosplat.config import LossConfig, TrainConfig
from thermosplat.datasets.frame_tensors import FrameTensors
from thermosplat.export.scene import spectrum_splats
from thermosplat.losses.image_terms import compare_frame
from thermosplat.scene.gaussians import Gaussians
from thermosplat.scene.model import SceneModel
from thermosplat.scene.packed_parameters import num_bytes, pack, unpack
from thermosplat.training.budget.feature_channels import principal_directions, reduce_features
from thermosplat.training.budget.image_change import ImageChange
from thermosplat.training.density.gaussian_ops import Optimizers
from toy_scene import render, toy_capture, toy_config, toy_frame, toy_model

EXACT = 1e-10
"""Of the toy images' error, which is large: what rounding changes."""
THREE: dict[str, dict[str, Any]] = {"nir": {"opacity": "offset"}}


def with_none_of(*spectra: str) -> dict[str, dict[str, Any]]:
    """Three spectra, of which losses see no channel of these."""
    weights = {name: {"features": 0.0} for name in spectra}
    return {name: THREE.get(name, {}) | weights.get(name, {}) for name in ("rgb", "thermal", "nir")}


def model_of_rank(
    rank: int, aligned: bool = True, others: tuple[str, ...] = (), **settings: Any
) -> tuple[SceneModel, Optimizers, ImageChange]:
    """A toy model whose features of 8 channels lie in a space of ``rank`` dimensions, stepped once, and its images."""
    capture, config = toy_capture(aligned=aligned, others=others), toy_config(**settings)
    model = toy_model(config, capture)
    optimizers = stepped_optimizers(model.gaussians("shared"))
    generator = torch.Generator().manual_seed(2)
    features = model.gaussians("shared").features
    with torch.no_grad():
        features.copy_(
            torch.randn(len(features), rank, generator=generator) @ torch.randn(rank, 8, generator=generator)
        )
    return model, optimizers, ImageChange(model, [toy_frame(capture)], 1, config)


@pytest.mark.parametrize("kept", [1, 3, 5])
def test_principal_directions_lose_least(kept: int) -> None:
    """Against random projections of that rank, and those of plain principal components; all directions lose nothing."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    jacobian, features = normal(40, 6) * normal(6).exp(), normal(50, 6) @ normal(6, 6)
    answers, moments = jacobian.T @ jacobian, features.T @ features

    def lost(projection: Tensor) -> float:
        rest = torch.eye(6, dtype=torch.float64) - projection
        return torch.trace(answers @ rest.T @ moments @ rest).item()

    towards, back = principal_directions(answers, moments)
    torch.testing.assert_close(towards @ back, torch.eye(6, dtype=torch.float64))
    least = lost(towards[:, :kept] @ back[:kept])
    found = torch.linalg.eigvals(answers @ moments).real
    assert least == pytest.approx(found.sort().values[: 6 - kept].sum().item(), rel=1e-6)
    plain = torch.linalg.eigh(moments)[1][:, -kept:]
    assert least < lost(plain @ plain.T)
    for _ in range(100):
        columns, rows = normal(6, kept), normal(kept, 6)
        assert least < lost(columns @ torch.linalg.inv(rows @ columns) @ rows)


def test_a_direction_that_nothing_answers_to_goes_first() -> None:
    """Images that ignore a channel, however large its features are, do not miss it."""
    answers, moments = torch.diag(torch.tensor([1.0, 0.0, 1.0])), torch.diag(torch.tensor([1.0, 100.0, 2.0]))
    towards, back = principal_directions(answers, moments)
    projection = (towards[:, :2] @ back[:2]).float()
    torch.testing.assert_close(projection, torch.diag(torch.tensor([1.0, 0.0, 1.0])), rtol=0, atol=1e-3)


@pytest.mark.parametrize("aligned", [True, False])
@pytest.mark.parametrize("others", [{}, {"nir": {}, "red": {"opacity": "own", "features": None}}])
@pytest.mark.parametrize("rank", [4, 6])
def test_channels_are_found(rank: int, others: dict[str, dict[str, Any]], aligned: bool) -> None:
    """Of features of that rank so many channels are left, in half a basis; images and channels are the same."""
    model, optimizers, change = model_of_rank(rank, aligned, tuple(others), spectra=others)
    gaussians, frame = model.gaussians("shared"), change.frames[0]
    before = model.render(frame.views, sh_degree=1)
    left = reduce_features(model, optimizers, change, EXACT)
    assert left == rank
    assert gaussians.features.shape == (60, rank)
    basis = gaussians.feature_basis
    assert basis is not None
    torch.testing.assert_close(basis.T @ basis, torch.eye(rank))
    after = model.render(frame.views, sh_degree=1)
    assert after.images.keys() == after.features.keys() == frame.views.keys()
    for name in frame.views:
        torch.testing.assert_close(after.images[name], before.images[name], rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(after.features[name], before.features[name], rtol=1e-4, atol=1e-4)
    assert change.now() < EXACT


def test_fewer_at_a_price() -> None:
    """A larger tolerance leaves fewer channels, never none, and the images change within it."""
    found = {}
    for tolerance in (0.0, 1e-3, 1e-1, 1e9):
        model, optimizers, change = model_of_rank(8)
        found[tolerance] = reduce_features(model, optimizers, change, tolerance)
        assert change.now() <= tolerance
    assert found[0.0] == 8 >= found[1e-3] >= found[1e-1] > found[1e9] == 1
    model, optimizers, change = model_of_rank(8)
    before = [parameter.detach().clone() for parameter in model.parameters()]
    assert reduce_features(model, optimizers, change, 0.0) == 8
    assert model.gaussians("shared").feature_basis is None
    assert all(torch.equal(*pair) for pair in zip(model.parameters(), before, strict=True))


def test_reduced_twice() -> None:
    """What is left is reduced like the features were; the basis is that of both."""
    model, optimizers, change = model_of_rank(8)
    gaussians = model.gaussians("shared")
    first = reduce_features(model, optimizers, change, 0.05)
    once = ImageChange(model, change.frames, 1, change.losses)
    second = reduce_features(model, optimizers, once, 1.0)
    assert 8 > first > second
    assert once.now() <= 1.0
    basis = gaussians.feature_basis
    assert basis is not None
    assert basis.shape == (8, second)
    torch.testing.assert_close(basis.T @ basis, torch.eye(second))


def test_reduced_twice_to_what_is_used() -> None:
    """Coordinates that lie in a space of three dimensions are found to do so, whatever basis they are of."""
    model, optimizers, change = model_of_rank(6)
    assert reduce_features(model, optimizers, change, EXACT) == 6
    features = model.gaussians("shared").features
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        features[:, 3:] = features[:, :3] @ torch.randn(3, 3, generator=generator)
    once = ImageChange(model, change.frames, 1, change.losses)
    assert reduce_features(model, optimizers, once, EXACT) == 3
    assert once.now() < EXACT


def test_supervised_channels_are_kept() -> None:
    """Channels that no image shows stay where a loss sees them, and go where none does."""
    left = {}
    for losses in (None, toy_config()):
        model, optimizers, change = model_of_rank(8)
        first = model.formations.decoder.shared_encoder[0]  # type: ignore[union-attr,index]
        with torch.no_grad():
            first.weight[:, :4] = 0.0  # type: ignore[union-attr,operator,index]
        change = ImageChange(model, change.frames, 1, losses)
        left[losses is None] = reduce_features(model, optimizers, change, EXACT)
    assert left == {True: 4, False: 8}


@pytest.mark.parametrize(
    ("losses", "expected"),
    [
        (toy_config(spectra=THREE), 5),  # three colours, an intensity, and near infrared
        (dataclasses.replace(toy_config(spectra=THREE), loss=LossConfig(features=0.0)), 1),
        (toy_config(spectra=with_none_of("rgb")), 2),
        (toy_config(spectra=with_none_of("rgb", "thermal")), 1),
        (toy_config(spectra=with_none_of("nir")), 4),
    ],
)
def test_channels_of_three_spectra_are_kept_as_losses_see_them(losses: TrainConfig, expected: int) -> None:
    """Where decoders look at nothing, the channels that are left are those of the spectra with a loss on channels."""
    model, optimizers, change = model_of_rank(8, others=("nir",), spectra=THREE)
    with torch.no_grad():
        model.formations.decoder.shared_encoder[0].weight.zero_()  # type: ignore[union-attr,index,operator]
    change = ImageChange(model, change.frames, 1, losses)
    assert reduce_features(model, optimizers, change, EXACT) == expected
    assert change.now() < EXACT


def test_what_no_image_shows_and_losses_see_alone_is_kept() -> None:
    """Where decoders look at nothing, the channels that losses supervise are left, and no other."""
    model, optimizers, change = model_of_rank(8)
    with torch.no_grad():
        model.formations.decoder.shared_encoder[0].weight.zero_()  # type: ignore[union-attr,index,operator]
    change = ImageChange(model, change.frames, 1, toy_config())
    assert reduce_features(model, optimizers, change, EXACT) == 4
    assert change.now() < EXACT


def model_of_two_halves() -> tuple[SceneModel, Optimizers, FrameTensors]:
    """A model of which RGB sees the first four channels of the features and thermal the others."""
    decoder = {"branches": "separate", "modulation": False}
    model, optimizers, change = model_of_rank(8, decoder=decoder)
    with torch.no_grad():
        model.formations.decoder.networks["rgb"][0].weight[:, 4:] = 0.0  # type: ignore[union-attr,index]
        model.formations.decoder.networks["thermal"][0].weight[:, :4] = 0.0  # type: ignore[union-attr,index]
    return model, optimizers, change.frames[0]


def test_what_is_not_covered_does_not_count() -> None:
    """Thermal images in which no Gaussian is keep no channel, however much their decoder would make of it."""
    model, optimizers, frame = model_of_two_halves()
    with torch.no_grad():
        model.gaussians("shared").thermal_opacity_offsets.fill_(-40.0)
        model.formations.decoder.networks["thermal"][0].weight *= 100.0  # type: ignore[union-attr,index,operator]
    assert reduce_features(model, optimizers, ImageChange(model, [frame], 1), EXACT) == 4


def test_spectra_count_by_their_errors() -> None:
    """Where thermal images are all but exact, RGB gives up its channels first, although it would change more."""
    model, optimizers, frame = model_of_two_halves()
    with torch.no_grad():
        model.formations.decoder.networks["thermal"][0].weight *= 0.1  # type: ignore[union-attr,index,operator]
        exact = render(model, frame, only=("thermal",)).images["thermal"]
    nearly = dataclasses.replace(frame.views["thermal"], image=exact + 1e-5)
    frame = dataclasses.replace(frame, views=frame.views | {"thermal": nearly})
    assert reduce_features(model, optimizers, ImageChange(model, [frame], 1), 1.0) <= 4


def test_training_goes_on_with_what_is_left() -> None:
    """Coordinates and their moments are stepped; a step in them is a step of the features in the space that is left."""
    model, optimizers, change = model_of_rank(5)
    gaussians, frame = model.gaussians("shared"), change.frames[0]
    reduce_features(model, optimizers, change, EXACT)
    before = gaussians.features.detach().clone()
    rendered = model.render(frame.views, sh_degree=1)
    sum(compare_frame(rendered, frame, toy_config()).losses.values()).backward()  # type: ignore[union-attr]
    assert gaussians.features.grad is not None
    assert gaussians.features.grad.shape == (60, 5)
    optimizers["features"].step()
    assert (gaussians.features != before).all()
    for moment in ("exp_avg", "exp_avg_sq"):
        assert optimizers["features"].state[gaussians.features][moment].shape == (60, 5)


def test_what_is_left_is_stored_and_exported() -> None:
    """A set comes back with its basis, in fewer bytes; viewers get the same colours."""
    model, optimizers, change = model_of_rank(4)
    gaussians, scales = model.gaussians("shared"), toy_capture().scales
    splats = spectrum_splats(model, "rgb", scales)
    before = num_bytes(pack(gaussians.state_dict()))
    reduce_features(model, optimizers, change, EXACT)
    packed = pack(gaussians.state_dict())
    assert num_bytes(packed) == before - 4 * (60 * 4 - 8 * 4)
    restored = Gaussians(unpack(packed, 3))
    assert dict(restored.state_dict()).keys() == dict(gaussians.state_dict()).keys()
    assert all(torch.equal(value, gaussians.state_dict()[name]) for name, value in restored.state_dict().items())
    torch.testing.assert_close(spectrum_splats(model, "rgb", scales).sh0, splats.sh0, rtol=1e-4, atol=1e-4)


def test_decoders_that_see_directions() -> None:
    """Of MS-Splatting's decoders' inputs features alone are reduced."""
    decoder = {"branches": "separate", "modulation": False, "view_direction": True}
    model, optimizers, change = model_of_rank(5, decoder=decoder)
    assert reduce_features(model, optimizers, change, EXACT) == 5
    assert change.now() < EXACT


def test_decoders_that_see_waves_of_the_features() -> None:
    """How images answer goes through the waves, too: here through them alone."""
    model, optimizers, change = model_of_rank(5, decoder={"fourier_frequency": 3.0})
    with torch.no_grad():
        model.formations.decoder.shared_encoder[0].weight[:, :8] = 0.0
    change = ImageChange(model, change.frames, 1, toy_config())
    assert reduce_features(model, optimizers, change, EXACT) == 5
    assert change.now() < EXACT


def test_interrupted_search_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C while it is tried how many channels may go: features and moments are as they were."""
    model, optimizers, change = model_of_rank(8)
    gaussians = model.gaussians("shared")
    before = gaussians.features.detach().clone()
    looks = []

    def now() -> float:
        looks.append(0)
        if len(looks) == 2:
            raise KeyboardInterrupt
        return 0.0

    monkeypatch.setattr(change, "now", now)
    with pytest.raises(KeyboardInterrupt):
        reduce_features(model, optimizers, change, 0.1)
    assert torch.equal(gaussians.features, before)
    assert gaussians.feature_basis is None
    assert gaussians.features in optimizers["features"].state
