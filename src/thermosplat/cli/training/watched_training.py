"""A training that is shown in the browser as it goes on."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from thermosplat.cli.viewer_flags import ViewerFlags

if TYPE_CHECKING:
    from thermosplat.training.trainer import Trainer


@contextmanager
def watched(trainer: "Trainer", flags: ViewerFlags) -> Iterator[None]:
    """Around a training: serve the viewer meanwhile, if it is asked for.

    Args:
        trainer: The training.
        flags: Where it is shown.

    Raises:
        UserError: viser is not installed, or the address cannot be served at.
    """
    if flags.port is None:
        yield
        return
    from thermosplat.viewer.front_end import Viewer
    from thermosplat.viewer.opening import FOLDER
    from thermosplat.viewer.training_watch import TrainingWatch
    from thermosplat.viewer.viewed_scene import ViewedScene

    capture, model = trainer.capture, trainer.model
    scales = {name: capture.scales[name] for name in model.spectra}
    scene = ViewedScene(capture.name, model, trainer.sh_degree, scales, trainer.device, capture)
    watch = TrainingWatch(scene, trainer.config.max_steps, trainer.run.metrics_jsonl)
    viewer = Viewer(scene, trainer.run.path / FOLDER, host=flags.host, port=flags.port, watch=watch)
    trainer.logger.say(f"The viewer: {viewer.url}")
    trainer.between_steps = watch.between_steps
    try:
        yield
    finally:
        trainer.between_steps = None
        viewer.stop()
