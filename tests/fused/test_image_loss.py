"""The Warp image loss is kornia's, forward and gradient, for any size, stride and share."""

import kornia
import pytest
import torch

from thermosplat.fused.image_loss import ImageTerm, warp_image_loss, warp_image_losses
from thermosplat.losses.image_terms import image_loss, smoothness


def _images(height: int, width: int, channels: int, device: torch.device, dtype: torch.dtype) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(height * width + channels)
    target = torch.rand(height, width, channels, generator=generator, dtype=torch.float64)
    render = target + 0.2 * torch.randn(height, width, channels, generator=generator, dtype=torch.float64)
    render[: height // 2, :3] = target[: height // 2, :3]  # equal pixels: |0| has gradient 0
    return [render.to(device, dtype), target.to(device, dtype)]


@pytest.mark.parametrize("ssim_lambda", [0.0, 0.2, 1.0])
@pytest.mark.parametrize(
    ("height", "width", "channels"), [(6, 6, 1), (7, 30, 3), (33, 9, 3), (23, 41, 1), (16, 16, 4), (37, 71, 2)]
)
def test_same_as_kornia(device: torch.device, height: int, width: int, channels: int, ssim_lambda: float) -> None:
    """Loss and gradient in float64 equal kornia's SSIM and torch's L1."""
    render, target = _images(height, width, channels, device, torch.float64)
    ours, theirs = render.clone().requires_grad_(), render.clone().requires_grad_()
    ssim = kornia.metrics.ssim(theirs.permute(2, 0, 1)[None], target.permute(2, 0, 1)[None], 11).mean()
    expected = (1 - ssim_lambda) * (theirs - target).abs().mean() + ssim_lambda * (1 - ssim)
    found = warp_image_loss(ours, target, ssim_lambda)
    (3.0 * expected).backward()
    (3.0 * found).backward()
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-13)
    torch.testing.assert_close(ours.grad, theirs.grad, rtol=1e-9, atol=1e-14)


def test_float32_is_as_near_to_the_truth_as_kornia(device: torch.device) -> None:
    """Single precision loses no more than the filters it replaces."""
    exact, target = _images(60, 80, 3, device, torch.float64)
    gradients = []
    for image, wanted, loss in (
        (exact, target, warp_image_loss),
        (exact.float(), target.float(), warp_image_loss),
        (exact.float(), target.float(), lambda *images: image_loss(*(i.cpu() for i in images[:2]), images[2])),
    ):
        leaf = image.clone().requires_grad_()
        loss(leaf, wanted, 0.2).backward()
        gradients.append(leaf.grad.double())
    ours, theirs = (float((gradient - gradients[0]).norm()) for gradient in gradients[1:])
    assert ours < 1.5 * theirs
    assert ours < 1e-5 * float(gradients[0].norm())


def test_views_with_strides(device: torch.device) -> None:
    """Some channels of a wider image give the same as a copy of them; their gradient goes to those channels alone."""
    render, target = _images(20, 24, 6, device, torch.float32)
    wide = render.clone().requires_grad_()
    copy = render[..., 1:4].clone().requires_grad_()
    loss = warp_image_loss(wide[..., 1:4], target[..., 2:5], 0.2)
    expected = warp_image_loss(copy, target[..., 2:5].contiguous(), 0.2)
    loss.backward()
    expected.backward()
    assert loss == expected
    assert torch.equal(wide.grad[..., 1:4], copy.grad)
    assert wide.grad[..., 0].abs().sum() == wide.grad[..., 4:].abs().sum() == 0


def test_gradcheck(device: torch.device) -> None:
    """Numerical derivatives agree, borders included."""
    render, target = _images(7, 8, 2, device, torch.float64)
    render += 0.01  # away from |0|
    assert torch.autograd.gradcheck(lambda image: warp_image_loss(image, target, 0.3), render.requires_grad_())


def test_no_gradient_wanted(device: torch.device) -> None:
    """Without a gradient nothing is kept for one."""
    render, target = _images(12, 12, 3, device, torch.float32)
    assert not warp_image_loss(render, target, 0.2).requires_grad


@pytest.mark.parametrize(("count", "smoothed"), [(4, 3), (5, 4), (5, 0), (9, 8), (9, None)])
def test_any_number_of_terms(device: torch.device, count: int, smoothed: int | None) -> None:
    """Losses, squared errors, smoothness and gradients of each are those of kornia and torch in float64."""
    pairs = [_images(17, 23, 1 + number % 3, device, torch.float64) for number in range(count)]
    ours = [render.clone().requires_grad_() for render, _ in pairs]
    theirs = [render.clone().requires_grad_() for render, _ in pairs]
    terms = [
        ImageTerm(f"term {number}", 0.5 + number, image, target)
        for number, (image, (_, target)) in enumerate(zip(ours, pairs, strict=True))
    ]
    found = warp_image_losses(terms, 0.2, smoothed=smoothed, smoothness=0.3)
    expected = []
    for number, (image, (_, target)) in enumerate(zip(theirs, pairs, strict=True)):
        ssim = kornia.metrics.ssim(image.permute(2, 0, 1)[None], target.permute(2, 0, 1)[None], 11).mean()
        expected.append((0.5 + number) * (0.8 * (image - target).abs().mean() + 0.2 * (1 - ssim)))
        error = (image.detach().clamp(0.0, 1.0) - target).square().mean()
        torch.testing.assert_close(found.squared_errors[number], error, rtol=1e-12, atol=1e-14)
    assert len(found.losses) == len(found.squared_errors) == count
    torch.testing.assert_close(torch.stack(found.losses), torch.stack(expected), rtol=1e-12, atol=1e-13)
    smooth = torch.zeros_like(expected[0]) if smoothed is None else 0.3 * smoothness(theirs[smoothed])
    torch.testing.assert_close(found.smoothness, smooth, rtol=1e-12, atol=1e-13)
    factors = torch.arange(1.0, count + 1.0, dtype=torch.float64, device=device)
    ((factors * torch.stack(found.losses)).sum() + found.smoothness).backward()
    ((factors * torch.stack(expected)).sum() + smooth).backward()
    for image, wanted in zip(ours, theirs, strict=True):
        torch.testing.assert_close(image.grad, wanted.grad, rtol=1e-9, atol=1e-13)


def test_one_image_in_several_launches(device: torch.device) -> None:
    """Its gradients are added up."""
    render, target = _images(12, 14, 3, device, torch.float64)
    once, often = render.clone().requires_grad_(), render.clone().requires_grad_()
    warp_image_loss(once, target, 0.2).backward()
    sum(warp_image_losses([ImageTerm("a", 1.0, often, target)] * 6, 0.2).losses).backward()
    torch.testing.assert_close(often.grad, 6 * once.grad, rtol=1e-12, atol=1e-15)


def test_no_image_has_no_loss() -> None:
    """It would be a loss of nothing."""
    with pytest.raises(ValueError, match="at least one image loss"):
        warp_image_losses([], 0.2)
