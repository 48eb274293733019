"""As many latent channels as the training images need: ``--budget auto``.

Features f of all Gaussians that lie in a space of r < d dimensions are f = B c, with a basis B [d, r] and
coordinates c [r] of each Gaussian. Blending is linear, so that c is blended in place of f and A_f = B A_c: r channels
to train, to blend and to store, for losses and decoders that see all d.

Which space? Decoded images answer to a change of A_f by their Jacobian J. With M = Σ JᵀJ and S = Σ A_f A_fᵀ, summed
over pixels of training views, the projection P of rank r that changes the images least makes tr(M (I-P) S (I-P)ᵀ) least
if how images answer and what features there are have nothing to do with each other: P = M^-1/2 V Vᵀ M^1/2, with V the
leading eigenvectors of M^1/2 S M^1/2 (principal components in the metric of the images). Channels that losses compare
with images count as images too: where fewer directions were left than losses supervise, later steps would give up the
decoded images for theirs. Rendering all of these then decides how many directions are enough.
"""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from thermosplat.scene.initial_gaussians import SHARED
from thermosplat.scene.model import SceneModel
from thermosplat.training.budget.image_change import ImageChange, most_within
from thermosplat.training.density.gaussian_ops import Optimizers, in_new_basis, kept_on_failure

_PIXELS = 2**15
"""Most pixels of an image whose Jacobian is looked at, spread over all of it."""
_LEAST_ANSWER = 1e-9
"""A direction that no image answers to counts as much, as a share of the one they answer to most: M^1/2 is inverted."""


@torch.no_grad()
def reduce_features(model: SceneModel, optimizers: Optimizers, change: ImageChange, tolerance: float) -> int:
    """Leave as few latent channels as change the images within the tolerance.

    Args:
        model: A scene with features.
        optimizers: Of the shared set; what Adam knows of the features is turned with them.
        change: The images from before, with the channels that losses supervise.
        tolerance: Largest change (``ImageChange.now``).

    Returns:
        The channels that are left, at least 1.
    """
    gaussians = model.gaussians(SHARED)
    features, channels = gaussians.features, gaussians.features.shape[1]
    towards, back = principal_directions(*_moments(model, change))  # coordinates [r, r] and features again
    saved = features.detach().clone()

    def project(dropped: int) -> None:
        kept = channels - dropped
        features.copy_(saved if dropped == 0 else saved @ (towards[:, :kept] @ back[:kept]).to(saved))

    with kept_on_failure([features]):
        dropped = most_within(change, channels - 1, project, tolerance)
        features.copy_(saved)
    if dropped == 0:
        return channels
    # an orthonormal basis keeps lengths, and with them what a learning rate means
    basis, scales = torch.linalg.qr(back[: channels - dropped].T)
    into = towards[:, : channels - dropped] @ scales.T
    old = gaussians.feature_basis
    new = (basis if old is None else old.double().cpu() @ basis).to(saved)
    in_new_basis(gaussians, optimizers, "features", into, basis)
    gaussians.feature_basis = new
    return channels - dropped


def principal_directions(answers: Tensor, moments: Tensor) -> tuple[Tensor, Tensor]:
    """Principal components of features in the metric of the images.

    Args:
        answers: M, shape [d, d].
        moments: S, shape [d, d].

    Returns:
        M^1/2 V and Vᵀ M^-1/2, float64 [d, d], so that features times the first k columns of the one times the first k
        rows of the other are features of k dimensions.
    """
    values, vectors = torch.linalg.eigh(answers.double())
    roots = values.clamp(min=_LEAST_ANSWER * float(values[-1])).clamp(min=torch.finfo(torch.float64).tiny).sqrt()
    root, inverse = (vectors * roots) @ vectors.T, (vectors / roots) @ vectors.T
    leading = torch.linalg.eigh(root @ moments.double() @ root)[1].flip(1)
    return root @ leading, leading.T @ inverse


def _moments(model: SceneModel, change: ImageChange) -> tuple[Tensor, Tensor]:
    """M, each spectrum's divided by its error, and S, of the coordinates that are blended now; on the CPU."""
    device, dim = model.background.device, model.config.feature_dim
    answers, moments = torch.zeros(2, dim, dim, device=device, dtype=torch.float64)
    for frame in change.frames:
        rendered = model.render(frame.views, sh_degree=change.sh_degree, shared_cameras=frame.shared_cameras)
        for name, features in rendered.features.items():
            if name not in change.errors:
                continue
            alpha = rendered.alphas[name]
            every = -(-alpha.numel() // _PIXELS)
            shown = model.formations[name].pixels_of_features
            pixels = partial(shown, alpha=alpha, view=frame.views[name], every=every)
            answers += _answers(pixels, features, every) / change.errors[name]
            blended = features.flatten(0, 1)[::every].double()
            moments += blended.T @ blended / len(blended)
    for name, spectrum in model.spectra.items():
        first, beyond = spectrum.latent
        if (error := change.errors.get(f"features_{name}")) is not None:
            answers.diagonal()[first:beyond] += len(change.frames) / (beyond - first) / error
    answers, moments = answers.cpu(), moments.cpu()
    basis = model.gaussians(SHARED).feature_basis
    if basis is None:
        return answers, moments
    basis = basis.double().cpu()  # orthonormal: A_c = Bᵀ A_f
    return basis.T @ answers @ basis, basis.T @ moments @ basis


@torch.enable_grad()
def _answers(shown: Callable[[Tensor], Tensor], features: Tensor, every: int) -> Tensor:
    """Mean of JᵀJ over channels, and over each so many-th pixel, of an image that is formed of features [H, W, d].

    Args:
        shown: The pixels that are looked at, [P, C], of features.
        features: A_f, [H, W, d].
        every: So many-th.
    """
    features = features.detach().requires_grad_()
    pixels = shown(features)
    total = features.new_zeros(features.shape[-1], features.shape[-1], dtype=torch.float64)
    for channel in pixels.unbind(-1):
        (gradient,) = torch.autograd.grad(channel.sum(), features, retain_graph=True)
        of_pixels = gradient.flatten(0, 1)[::every].double()
        total += of_pixels.T @ of_pixels
    return total / pixels.numel()
