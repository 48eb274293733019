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


def joined_sets(scenes: Sequence[Scene], config: TrainConfig, formations: Formations) -> dict[str, Gaussians]:
    """What kept scenes become, by set."""
    restored = [restored_sets(scene, config, formations) for scene in scenes]
    return {name: joined([sets[name] for sets in restored]) for name in restored[0]}


@torch.no_grad()
def joined(scenes: Sequence[Gaussians]) -> Gaussians:
    """One set that has the Gaussians of several, which together are as opaque as one of them.

    Args:
        scenes: The same set of each scene.
    """
    parameters = [_with_all_channels(gaussians) for gaussians in scenes]
    both = Gaussians({name: torch.cat([of_scene[name] for of_scene in parameters]) for name in parameters[0]})
    others = {name: thinned_logits(both.logits_in(name), len(scenes)) for name in both.second_opacities}
    every = torch.arange(len(both), device=both.means.device)
    both.set_opacity_logits(every, thinned_logits(both.logit_opacities, len(scenes)), others)
    return both


def _with_all_channels(gaussians: Gaussians) -> dict[str, Tensor]:
    """Parameters of a set, with features themselves in place of coordinates in a basis of its own."""
    parameters: dict[str, Tensor] = dict(gaussians.named_parameters())
    if gaussians.feature_basis is not None:
        parameters["features"] = parameters["features"] @ gaussians.feature_basis.T
    return parameters


def thinned_logits(logits: Tensor, number: int) -> Tensor:
    """Logits of 1 - (1 - o)^(1/number): so many Gaussians of it, one before the other, are as opaque as one of o.

    Args:
        logits: Those of the opacities o.
        number: How many.
    """
    # 1 - o = exp(-softplus(logit)), and its root is exp of a part of that: exact for clear and for opaque ones
    depths = softplus(logits.double(), threshold=1e9) / number
    return (depths + torch.log(-torch.expm1(-depths))).to(logits)
