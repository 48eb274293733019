"""Gaussians: start from points, activations, state."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from thermosplat.config import DecoderConfig, ModelConfig
from thermosplat.errors import UserError
from thermosplat.scene.formations.formation import Formation
from thermosplat.scene.formations.scene_formations import Formations
from thermosplat.scene.gaussians import Gaussians, check_points
from thermosplat.scene.neighbor_distances import neighbor_distances
from thermosplat.spectra import Spectrum

C0 = 0.28209479177387814  # 1 / (2 √π)


def cloud(count: int = 40) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    return rng.normal(size=(count, 3)).astype(np.float32), rng.integers(0, 256, (count, 3), dtype=np.uint8)


RGB = Spectrum("rgb", 3, "photograph", "shared", (0, 3), "thermal")
THERMAL = Spectrum("thermal", 1, "scalar", "offset", (3, 4), None)
NIR = Spectrum("nir", 1, "scalar", "own", (4, 5), None)


def formations_of(config: ModelConfig, *spectra: Spectrum) -> list[Formation]:
    with torch.device("meta"):  # draws nothing
        formations = Formations(config, DecoderConfig(), spectra)
    return [formations[spectrum.name] for spectrum in spectra]


def start(
    config: ModelConfig | None = None,
    spectra: Sequence[Spectrum] = (RGB, THERMAL),
    *,
    seed: int = 0,
    sh_degree: int = 3,
) -> Gaussians:
    points, colors = cloud()
    generator = torch.Generator().manual_seed(seed)
    config = config or ModelConfig()
    formations = formations_of(config, *spectra)
    return Gaussians.from_points(
        points,
        colors,
        neighbor_distances(points),
        config=config,
        sh_degree=sh_degree,
        generator=generator,
        formations=formations,
    )


def test_start_of_the_shared_set() -> None:
    """Every parameter of a ThermoSplat set starts as documented."""
    points, colors = cloud()
    gaussians = start()
    expected_colors = torch.tensor(colors / 255.0, dtype=torch.float32)
    luma = (0.299 * colors[:, 0] + 0.587 * colors[:, 1] + 0.114 * colors[:, 2]) / 255
    assert len(gaussians) == 40
    torch.testing.assert_close(gaussians.means.detach(), torch.tensor(points))
    torch.testing.assert_close(gaussians.opacities.detach(), torch.full((40,), 0.1))
    torch.testing.assert_close(gaussians.opacities_in("thermal"), gaussians.opacities)
    torch.testing.assert_close(0.5 + C0 * gaussians.sh0[:, 0].detach(), expected_colors)
    assert gaussians.shN.shape == (40, 15, 3)
    assert not gaussians.shN.any()
    torch.testing.assert_close(gaussians.features[:, :3].detach(), expected_colors)
    np.testing.assert_allclose(gaussians.features[:, 3].detach(), luma, rtol=1e-5, atol=1e-6)
    assert 0.1 < gaussians.features[:, 4:].std() < 0.3
    torch.testing.assert_close(gaussians.quats.detach(), torch.tensor([[1.0, 0, 0, 0]]).expand(40, 4))


def test_scales_are_neighbour_distances() -> None:
    """Round Gaussians as large as the RMS distance to three neighbours."""
    points, _ = cloud()
    squared = np.square(points[:, None] - points[None]).sum(-1)
    squared.sort(axis=1)
    expected = np.sqrt(squared[:, 1:4].mean(1))
    scales = start(ModelConfig()).scales.detach().numpy()
    np.testing.assert_allclose(scales, np.repeat(expected[:, None], 3, 1), rtol=1e-4)


def test_parameter_names_follow_the_configuration() -> None:
    """Features and thermal offsets exist only where the model uses them."""
    base = {"means", "quats", "log_scales", "logit_opacities", "sh0", "shN"}

    def names(gaussians: Gaussians) -> set[str]:
        return set(dict(gaussians.named_parameters()))

    assert names(start()) == base | {"features", "thermal_opacity_offsets"}
    assert names(start(spectra=[RGB, replace(THERMAL, opacity="shared")])) == base | {"features"}
    assert names(start(spectra=[RGB])) == base | {"features"}
    three = start(spectra=[RGB, THERMAL, NIR])
    assert names(three) == base | {"features", "thermal_opacity_offsets", "logit_nir_opacities"}
    assert three.second_opacities == ("thermal", "nir")
    without = ModelConfig(feature_dim=0)
    assert names(start(without, [RGB])) == names(start(without, [THERMAL])) == base
    own = {"thermal_sh0", "thermal_shN", "thermal_opacity_offsets"}
    assert names(start(without, [RGB, THERMAL])) == base | own


def test_thermal_set_starts_grey() -> None:
    """A set for thermal images alone starts from the luma, equal in all channels."""
    gaussians = start(ModelConfig(feature_dim=0), [THERMAL])
    _, colors = cloud()
    luma = torch.tensor(colors / 255.0, dtype=torch.float32) @ torch.tensor([0.299, 0.587, 0.114])
    torch.testing.assert_close(0.5 + C0 * gaussians.sh0[:, 0].detach(), luma[:, None].expand(-1, 3))


def test_sh_degree_sets_the_size_of_shN() -> None:
    """Degree 0 has an empty shN; the renderer gets both parts as they are stored."""
    assert start(sh_degree=0).shN.shape == (40, 0, 3)
    gaussians = start(sh_degree=1)
    assert gaussians.sh_coeffs[0] is gaussians.sh0
    assert gaussians.sh_coeffs[1] is gaussians.shN
    assert gaussians.shN.shape == (40, 3, 3)


def test_seed_decides_the_features() -> None:
    """Equal seeds give equal features, other seeds others, and no global random number is drawn."""
    state = torch.get_rng_state()
    first, again, other = start(seed=1), start(seed=1), start(seed=2)
    assert torch.equal(first.features, again.features)
    assert not torch.equal(first.features[:, 4:], other.features[:, 4:])
    assert torch.equal(first.features[:, :4], other.features[:, :4])
    assert torch.equal(torch.get_rng_state(), state)


def test_thermal_opacity_is_offset_in_logits() -> None:
    """α_t = sigmoid(logit α + Δ), and both parameters get its gradient."""
    gaussians = start()
    with torch.no_grad():
        gaussians.thermal_opacity_offsets.copy_(torch.linspace(-3, 3, 40))
    expected = 1 / (1 + np.exp(-(np.log(0.1 / 0.9) + np.linspace(-3, 3, 40))))
    np.testing.assert_allclose(gaussians.opacities_in("thermal").detach(), expected, rtol=1e-5)
    gaussians.opacities_in("thermal").sum().backward()
    torch.testing.assert_close(gaussians.thermal_opacity_offsets.grad, gaussians.logit_opacities.grad)
    np.testing.assert_allclose(gaussians.logit_opacities.grad, expected * (1 - expected), rtol=1e-4)


def test_state_round_trip_keeps_a_changed_count() -> None:
    """As many Gaussians as were saved come back, not as many as there were points."""
    gaussians = start()
    for name, value in dict(gaussians.named_parameters()).items():
        setattr(gaussians, name, torch.nn.Parameter(value[:7].detach()))
    restored = Gaussians(gaussians.state_dict())
    assert len(restored) == 7
    for name, value in gaussians.state_dict().items():
        assert torch.equal(restored.state_dict()[name], value)


def test_restored_gaussians_do_not_share_memory() -> None:
    """Training on does not change the checkpoint's tensors."""
    state = start().state_dict()
    restored = Gaussians(state)
    with torch.no_grad():
        restored.means += 1
    assert not torch.equal(state["means"], restored.means)


def test_too_few_points_is_a_users_error() -> None:
    """A capture without enough sparse points is refused, with the COLMAP command that makes them."""
    points, _ = cloud(3)
    with pytest.raises(UserError, match=r"at least 4 sparse points, but the capture has 3\. .*colmap mapper"):
        check_points(points)


def test_points_that_are_not_finite_are_a_users_error() -> None:
    """NaN coordinates would spread to everything; they are counted and refused."""
    points, _ = cloud()
    points[[3, 5], 1] = np.nan, np.inf
    with pytest.raises(UserError, match="2 of the capture's 40 sparse points"):
        check_points(points)


def test_opacities_of_several_spectra() -> None:
    """Each spectrum sees its own opacity; setting them keeps how they are stored; the largest counts for penalties."""
    gaussians = start(spectra=[RGB, THERMAL, NIR])
    wanted = [torch.linspace(start, 2.0, 40) for start in (-2.0, 0.0, 1.0)]
    gaussians.set_opacity_logits(torch.arange(40), wanted[0], {"thermal": wanted[1], "nir": wanted[2]})
    torch.testing.assert_close(gaussians.logits_in("rgb").detach(), wanted[0])
    torch.testing.assert_close(gaussians.logits_in("thermal").detach(), wanted[1])
    torch.testing.assert_close(gaussians.logit_nir_opacities.detach(), wanted[2])
    torch.testing.assert_close(gaussians.thermal_opacity_offsets.detach(), wanted[1] - wanted[0])
    largest = torch.stack(wanted).amax(dim=0)
    torch.testing.assert_close(gaussians.largest_opacities.detach(), torch.sigmoid(largest))
    second = gaussians.stored_second_opacity
    assert not second.is_offset
    torch.testing.assert_close(second.values.detach(), torch.stack(wanted[1:]).amax(dim=0))
