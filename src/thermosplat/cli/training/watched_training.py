"""A training that is shown in the browser as it goes on."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING

from thermosplat.cli.viewer_flags import ViewerFlags

if TYPE_CHECKING:
    from thermosplat.training.trainer import Trainer
    from thermosplat.viewer.training_watch import TrainingWatch


@contextmanager
def watched(trainer: "Trainer", flags: ViewerFlags) -> Iterator[None]:
    """Around a training: serve the viewer meanwhile, if it is asked for.

    Raises:
        UserError: viser is not installed, or the address cannot be served at.
    """
    if flags.port is None:
        yield
        return
    with _served(trainer, flags) as watch:
        trainer.between_steps = watch.between_steps
        yield


@contextmanager
def watched_by_first(trainer: "Trainer", flags: ViewerFlags) -> Iterator[None]:
    """Around a training on several ranks: let rank 0 serve the viewer meanwhile, if it is asked for there.

    Args:
        flags: Where it is shown; what rank 0 has counts.

    Raises:
        UserError: As of ``watched``, on rank 0.
        EndedElsewhere: On the other ranks where rank 0 cannot serve it.
    """
    from thermosplat.training.watched_ranks import Follower, Leader

    with ExitStack() as serving:

        def begin() -> bool:
            if flags.port is not None:
                Leader(trainer, serving.enter_context(_served(trainer, flags)))
            return flags.port is not None

        if trainer.team.asked_of_first(begin) and not trainer.team.is_first:
            Follower(trainer)
        yield


@contextmanager
def _served(trainer: "Trainer", flags: ViewerFlags) -> "Iterator[TrainingWatch]":
    """Around a training: the page with the training's scene, and what its visitors ask."""
    from thermosplat.viewer.front_end import Viewer
    from thermosplat.viewer.opening import FOLDER
    from thermosplat.viewer.training_watch import TrainingWatch
    from thermosplat.viewer.viewed_scene import ViewedScene

    capture, model = trainer.capture, trainer.model
    scales = {name: capture.scales[name] for name in model.spectra}
    scene = ViewedScene(capture.name, model, trainer.sh_degree, scales, trainer.device, capture)
    watch = TrainingWatch(scene, trainer.config.max_steps, trainer.run.metrics_jsonl)
    viewer = Viewer(scene, trainer.run.path / FOLDER, host=flags.host, port=flags.port or 0, watch=watch)
    trainer.logger.say(f"The viewer: {viewer.url}")
    try:
        yield watch
    finally:
        trainer.between_steps = None
        viewer.stop()
