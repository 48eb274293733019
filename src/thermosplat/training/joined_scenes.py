"""Scenes that are trained apart and become one: ``scenes``.

Two trainings of a capture agree on what the images say, and differ by chance in what they leave open. The mean of what
both show is nearer to views that nobody took than either is, as with any ensemble. A scene that has the Gaussians of
both, each as opaque as half of them, shows about that mean (equation 18 of docs/thermosplat-plus.md). The steps that
are left mend what is not so, where Gaussians of the one hide those of the other.
"""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor
from torch.nn.functional import softplus

from thermosplat.config import TrainConfig
from thermosplat.runs.checkpoint_file import on_host
from thermosplat.scene.formations.scene_formations import Formations
from thermosplat.scene.gaussians import Gaussians
from thermosplat.scene.model import SceneModel
from thermosplat.scene.saved_gaussians import restored_sets
from thermosplat.scene.smoothing_filter import SamplingCamera, opacity_factors, set_filter

Scene = Mapping[str, Mapping[str, Tensor]]
"""Parameters of each set of Gaussians, packed as in a checkpoint."""
_SEEDS_APART = 1_000_003
"""Between the seeds of two scenes: a prime, so that seeds which users count up do not meet."""
_LAST_SEED = 2**63


def seed_of_scene(seed: int, number: int) -> int:
    """The seed of a scene; of the first, and of what all become, it is the run's.

    Args:
        number: The scene, from 0.
    """
    return (seed + number * _SEEDS_APART) % _LAST_SEED


def steps_of_scene(config: TrainConfig) -> int:
    """Steps of each scene before all become one."""
    return max(1, round(config.optimizer.cooldown_from * config.max_steps))


def kept_scene(model: SceneModel) -> Scene:
    """The Gaussians of a scene, in the host's memory."""
    scene: Scene = on_host(model.checkpoint_state().gaussian_sets)
    return scene


def joined_sets(
    scenes: Sequence[Scene],
    config: TrainConfig,
    formations: Formations,
    cameras: Mapping[str, Sequence[SamplingCamera]] | None = None,
) -> dict[str, Gaussians]:
    """What kept scenes become, by set.

    Args:
        cameras: By set those that its 3D smoothing filter is of; None: it has none.
    """
    restored = [restored_sets(scene, config, formations) for scene in scenes]
    for name, of_set in (cameras or {}).items():
        for sets in restored:
            set_filter(sets[name], of_set)
    return {name: joined([sets[name] for sets in restored]) for name in restored[0]}


@torch.no_grad()
def joined(scenes: Sequence[Gaussians]) -> Gaussians:
    """One set that has the Gaussians of several, which together are as opaque as one of them.

    Args:
        scenes: The same set of each scene.
    """
    parameters = [_with_all_channels(gaussians) for gaussians in scenes]
    both = Gaussians({name: torch.cat([of_scene[name] for of_scene in parameters]) for name in parameters[0]})
    if filters := [gaussians.filter_3d for gaussians in scenes if gaussians.filter_3d is not None]:
        both.filter_3d = torch.cat(filters)
    factors = opacity_factors(both)
    others = {name: thinned_logits(both.logits_in(name), len(scenes), factors) for name in both.second_opacities}
    every = torch.arange(len(both), device=both.means.device)
    both.set_opacity_logits(every, thinned_logits(both.logit_opacities, len(scenes), factors), others)
    return both


def _with_all_channels(gaussians: Gaussians) -> dict[str, Tensor]:
    """Parameters of a set, with features themselves in place of coordinates in a basis of its own."""
    parameters: dict[str, Tensor] = dict(gaussians.named_parameters())
    if gaussians.feature_basis is not None:
        parameters["features"] = parameters["features"] @ gaussians.feature_basis.T
    return parameters


def thinned_logits(logits: Tensor, number: int, factors: Tensor | None = None) -> Tensor:
    """Logits of 1 - (1 - o)^(1/number): so many Gaussians of it, one before the other, are as opaque as one of o.

    Args:
        logits: Those of the opacities o.
        number: How many.
        factors: What a filter multiplies opacities by: the products become thinner, not the opacities; None: nothing.
    """
    if factors is not None:
        shown = (factors * logits.double().sigmoid()).clamp(max=1.0 - 1e-12)
        return torch.logit(-torch.expm1(torch.log1p(-shown) / number) / factors, eps=1e-9).to(logits)
    # 1 - o = exp(-softplus(logit)), and its root is exp of a part of that: exact for clear and for opaque ones
    depths = softplus(logits.double(), threshold=1e9) / number
    return (depths + torch.log(-torch.expm1(-depths))).to(logits)
