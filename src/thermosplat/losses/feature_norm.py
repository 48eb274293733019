"""MS-Splatting's regularisation of latent features."""

from torch import Tensor


def feature_norm_loss(features: Tensor) -> Tensor:
    """Mean over the Gaussians of (|f| - 1)²: features stay near unit length.

    Args:
        features: Latent features, shape [N, d].

    Returns:
        The loss, a scalar.
    """
    return (features.norm(dim=-1) - 1.0).square().mean()
