"""Steps of the fit, line by line and captured."""

import pytest
import torch

from decoding_scene import cameras, decoding_model
from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.export.scene import Colors, spectrum_splats
from thermosplat.export.splat_fit.exact_images import ExactImages
from thermosplat.export.splat_fit.fit_steps import LOOK_EVERY, MEASURED, FitSteps
from thermosplat.export.splat_fit.learning_splats import BETAS, LearningSplats
from thermosplat.fused.adam import WarpAdam
from thermosplat.rasterizer import pair_capacity


def started(
    name: str, kind: str, device: torch.device, colors: Colors = "palette"
) -> tuple[FitSteps, list[ViewTensors]]:
    """A fit before its first step, and its cameras."""
    views, capture = cameras(name, kind, device)
    model, scale = decoding_model(capture).to(device), capture.scales[name]
    exact = ExactImages(model, name, scale, 1, colors)
    splats = spectrum_splats(model, name, capture.scales, colors=colors)
    error = 10.0 ** (-exact.mean_psnr(splats, views) / 20.0)
    return FitSteps(LearningSplats(splats, views, 1, error), exact), views


def psnr_of(fit: FitSteps, views: list[ViewTensors]) -> float:
    """PSNR of the splats against the model [dB]."""
    return fit.exact.mean_psnr(fit.learning.detached(), views)


def test_a_step_improves_the_splats(device: torch.device) -> None:
    """By the rates: none at a share of zero."""
    fit, views = started("rgb", "color", device)
    before = psnr_of(fit, views)
    fit.run(views[0], 0.0)
    assert psnr_of(fit, views) == before
    for step in range(30):
        fit.run(views[step % len(views)], 1.0)
    assert psnr_of(fit, views) > before + 3.0


def test_warps_adam_improves_the_splats_as_torchs_does(device: torch.device) -> None:
    """On CUDA the fit has its own Adam: what it ends at is what torch's ends at on the CPU."""
    (fit, views), (reference, on_cpu) = started("rgb", "color", device), started("rgb", "color", torch.device("cpu"))
    fit.captures = False
    if device.type == "cpu":
        learning = fit.learning
        groups = [
            {"params": group["params"], "lr": rate}
            for group, rate in zip(learning.adam.param_groups, learning.rates.unbind(), strict=True)
        ]
        learning.adam = WarpAdam(groups, betas=BETAS, eps=1e-15)
    for step in range(40):
        fit.run(views[step % len(views)], 1.0)
        reference.run(on_cpu[step % len(views)], 1.0)
    assert psnr_of(fit, views) == pytest.approx(psnr_of(reference, on_cpu), abs=0.2)
    for name, values in reference.learning.learnt.items():
        torch.testing.assert_close(fit.learning.learnt[name].cpu(), values, rtol=0.05, atol=0.02, msg=name)


@pytest.mark.cuda
@pytest.mark.parametrize(
    ("name", "kind", "colors"),
    [("rgb", "color", "palette"), ("thermal", "color", "scalar"), ("thermal", "scalar", "palette")],
)
def test_captured_steps_match_plain_ones(name: str, kind: str, colors: Colors) -> None:
    """After as many steps the splats are as near to the model and show the same, whatever the colours are made of."""
    device = torch.device("cuda")
    (plain, views), (captured, _) = (started(name, kind, device, colors) for _ in range(2))
    plain.captures = False
    smaller = ViewTensors(views[0].viewmat, views[0].K, views[0].width - 8, views[0].height - 4)
    for step in range(3 * MEASURED):
        view = smaller if step % 5 == 4 else views[step % len(views)]
        for fit in (plain, captured):
            fit.run(view, 1.0 - step / (3 * MEASURED))
    assert len(captured.graphs) == 2
    assert not plain.graphs
    assert abs(psnr_of(captured, views) - psnr_of(plain, views)) < 0.3
    images = [[fit.exact.render(fit.learning.detached(), view) for view in views] for fit in (plain, captured)]
    for ours, theirs in zip(*images, strict=True):
        assert (ours - theirs).square().mean() < 1e-4


@pytest.mark.cuda
def test_moved_splats_stay_in_the_captured_step() -> None:
    """Relocation changes what a graph works on, in place: later steps go on from there."""
    fit, views = started("thermal", "scalar", torch.device("cuda"))
    with torch.no_grad():
        fit.learning.learnt["logit_opacities"][::2] = -10.0
    for step in range(MEASURED + 4):
        fit.run(views[step % len(views)], 1.0)
    fit.learning.relocate(fit.exact, views, torch.Generator().manual_seed(0))
    before = psnr_of(fit, views)
    for step in range(40):
        fit.run(views[step % len(views)], 1.0)
    assert len(fit.graphs) == 1
    assert psnr_of(fit, views) > before


@pytest.mark.cuda
def test_pairs_without_room_change_nothing_and_get_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """A replay whose pairs do not fit leaves the splats as they are; after the next look there is more room."""
    monkeypatch.setattr(pair_capacity, "LEAST", 1)
    fit, views = started("rgb", "color", torch.device("cuda"))
    for step in range(MEASURED):
        fit.run(views[step % len(views)], 1.0)
    fit.capacity.spare = 0.25
    before = fit.learning.detached()
    for step in range(MEASURED, LOOK_EVERY - 1):
        fit.run(views[step % len(views)], 1.0)
    after = fit.learning.detached()
    torch.testing.assert_close(after.means, before.means, rtol=0, atol=0)
    torch.testing.assert_close(after.sh0, before.sh0, rtol=0, atol=0)
    fit.capacity.spare = 1.5
    fit.run(views[0], 1.0)
    assert not fit.graphs
    near = psnr_of(fit, views)
    for step in range(20):
        fit.run(views[step % len(views)], 0.3)
    assert psnr_of(fit, views) > near
