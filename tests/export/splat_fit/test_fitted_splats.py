"""Splats that are fitted to the exact render."""

import dataclasses

import pytest
import torch

from decoding_scene import cameras, decoding_model, start_hybrid_at
from thermosplat.errors import UserError
from thermosplat.export.scene import spectrum_splats
from thermosplat.export.splat_fit.fitted_splats import fit_splats
from thermosplat.export.splat_rendering import render_splats
from toy_scene import toy_config, toy_model


@pytest.mark.parametrize(("name", "kind"), [("rgb", "color"), ("thermal", "color"), ("thermal", "scalar")])
def test_the_fit_comes_nearer_to_the_exact_render(name: str, kind: str) -> None:
    """By decibels, in photographs, pseudo-colours and values through a palette; the model stays as it was."""
    views, capture = cameras(name, kind)
    model = decoding_model(capture)
    scale = capture.scales[name]
    before = {key: value.clone() for key, value in model.state_dict().items()}
    fit = fit_splats(model, name, scale, views, sh_degree=1, passes=30)
    assert fit.after > fit.before + 6.0
    assert not any(getattr(fit.splats, part).requires_grad for part in ("means", "sh0", "logit_opacities"))
    assert all(parameter.grad is None for parameter in model.parameters())
    for key, value in model.state_dict().items():
        torch.testing.assert_close(value, before[key], rtol=0, atol=0)


def test_the_numbers_are_those_of_the_images() -> None:
    """PSNR before the fit is that of the splats' image against the model's."""
    views, capture = cameras("rgb")
    model = decoding_model(capture)
    fit = fit_splats(model, "rgb", capture.scales["rgb"], views[:1], sh_degree=1, measured=views[2:3], passes=1)
    with torch.no_grad():
        exact = model.render({"rgb": views[2]}, sh_degree=1).images["rgb"].clamp(0, 1)
        shown = render_splats(spectrum_splats(model, "rgb", capture.scales), views[2]).clamp(0, 1)
    expected = -10 * torch.log10((shown - exact).square().mean()).item()
    assert fit.before == pytest.approx(expected, abs=1e-3)


def test_narrow_footprints_are_fitted_to_viewers_that_widen_them() -> None:
    """A model of narrow footprints whose decoder adds nothing: the fit alone brings others nearer to what it shows."""
    views, capture = cameras("rgb")
    model = toy_model(toy_config(eps2d=0.01), capture)
    start_hybrid_at(model, -20.0)
    fit = fit_splats(model, "rgb", capture.scales["rgb"], views, sh_degree=1, measured=views, passes=30)
    assert fit.after > fit.before + 10.0


def test_a_scalar_is_fitted_as_intensity() -> None:
    """With --colors scalar the splats are grey: the model's value, not its palette."""
    views, capture = cameras("thermal", "scalar")
    model = decoding_model(capture)
    fit = fit_splats(model, "thermal", capture.scales["thermal"], views, sh_degree=0, colors="scalar", passes=30)
    assert fit.after > fit.before
    torch.testing.assert_close(fit.splats.sh0[..., 0], fit.splats.sh0[..., 2], rtol=0, atol=1e-4)


def test_no_views_are_no_fit() -> None:
    """Without training views of the spectrum there is nothing to fit to; the message says how to go on."""
    _, capture = cameras("rgb")
    model = decoding_model(capture)
    with pytest.raises(UserError, match="--fit-passes 0"):
        fit_splats(model, "rgb", capture.scales["rgb"], [], sh_degree=1)


def test_what_is_exact_already_stays() -> None:
    """Where no pass comes nearer, the splats are returned as they were: here those of a decoder that adds nothing."""
    views, capture = cameras("rgb")
    model = toy_model(toy_config(), capture)
    start_hybrid_at(model, -20.0)
    fit = fit_splats(model, "rgb", capture.scales["rgb"], views, sh_degree=1, passes=1)
    assert fit.after == fit.before > 50
    torch.testing.assert_close(fit.splats.sh0, spectrum_splats(model, "rgb", capture.scales).sh0, rtol=0, atol=0)


def test_views_without_splats_do_no_harm() -> None:
    """Cameras that see the background alone are exact from the start; the splats stay finite."""
    views, capture = cameras("rgb")
    model = toy_model(toy_config(), capture)
    start_hybrid_at(model, 0.0)
    back = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    away = [dataclasses.replace(view, viewmat=back @ view.viewmat) for view in views]
    scale = capture.scales["rgb"]
    fit = fit_splats(model, "rgb", scale, [*views, *away], sh_degree=1, measured=views, passes=6)
    assert fit.after > fit.before
    assert fit_splats(model, "rgb", scale, away, sh_degree=1, passes=2).after == 100.0
    assert all(bool(torch.isfinite(value).all()) for value in vars(fit.splats).values())


def test_invisible_splats_are_used() -> None:
    """What another spectrum alone shows becomes a splat of this one, and its source says of which Gaussian."""
    views, capture = cameras("thermal", "scalar")
    model = decoding_model(capture)
    offsets, _ = model.gaussians("shared").stored_opacity("thermal")
    assert offsets is not None
    with torch.no_grad():
        offsets[::2] = -20.0
    fit = fit_splats(model, "thermal", capture.scales["thermal"], views, sh_degree=1, passes=20)
    moved = fit.sources != torch.arange(len(fit.sources))
    assert 0 < moved.sum() <= len(moved[::2])
    assert not moved[1::2].any()
    assert (torch.sigmoid(fit.splats.logit_opacities[moved]) > 0.004).float().mean() > 0.9
    assert (fit.sources[moved] % 2 == 1).all()
    assert fit.after > fit.before


def test_the_fit_is_the_same_every_time() -> None:
    """Two fits of one model agree to the bit on the CPU."""
    views, capture = cameras("rgb")
    model = decoding_model(capture)
    first, second = (fit_splats(model, "rgb", capture.scales["rgb"], views, sh_degree=1, passes=2) for _ in range(2))
    torch.testing.assert_close(first.splats.means, second.splats.means, rtol=0, atol=0)
    assert first.after == second.after
