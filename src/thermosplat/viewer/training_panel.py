"""Controls of a training that goes on: its step, pause, step, save and stop, and plots of losses and PSNR."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from thermosplat.spectra import label
from thermosplat.viewer.training_watch import TrainingWatch, is_loss, is_psnr

if TYPE_CHECKING:
    from thermosplat.viewer.visitor import Visitor

_STROKES = ("#e25822", "#4aa3ff", "#7bd88f", "#f2c94c", "#b28dff", "#ff8fb1", "#9aa5b1")
_MOST_POINTS = 400


class TrainingPanel:
    """The tab "Training"."""

    def __init__(self, visitor: "Visitor", watch: TrainingWatch) -> None:
        import viser

        self.watch = watch
        self._gui = visitor.client.gui
        self.text = self._gui.add_markdown("")
        self.progress = self._gui.add_progress_bar(0.0)
        self.pause = self._gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
        self.step = self._gui.add_button("One step", icon=viser.Icon.PLAYER_TRACK_NEXT, disabled=True)
        self.save = self._gui.add_button("Save a checkpoint", icon=viser.Icon.DEVICE_FLOPPY)
        self.stop = self._gui.add_button("Save and stop", icon=viser.Icon.PLAYER_STOP, color="red")
        self._plots: dict[str, Any] = {}
        self._shown = -1
        self._folder = self._gui.add_folder("Curves")
        self.pause.on_click(visitor.heard(self._pause))
        self.step.on_click(visitor.heard(watch.do_step))
        self.save.on_click(visitor.heard(watch.save))
        self.stop.on_click(visitor.heard(watch.stop))
        self.update()

    def update(self) -> None:
        """Show how far the training is."""
        watch = self.watch
        state = "paused at step" if watch.paused else "step"
        self.text.content = f"**{state} {watch.step:,} of {watch.max_steps:,}** {watch.message}"
        self.progress.value = 100.0 * watch.step / max(1, watch.max_steps)
        self.pause.label = "Go on" if watch.paused else "Pause"
        self.step.disabled = not watch.paused
        lines = watch.curves.read()
        if len(lines) != self._shown and len(lines) > 1:
            self._shown = len(lines)
            self._plot("PSNR [dB], training views", is_psnr, lambda name: label(name.removeprefix("psnr_")))
            self._plot("Losses", is_loss, lambda name: name)

    def _pause(self) -> None:
        self.watch.pause(not self.watch.paused)
        self.update()

    def _plot(self, title: str, wanted: Callable[[str], bool], called: Callable[[str], str]) -> None:
        steps, values = self.watch.curves.series(wanted)
        if not values:
            return
        every = slice(None, None, max(1, len(steps) // _MOST_POINTS))
        data = tuple(np.array(column, np.float64)[every] for column in (steps, *values.values()))
        plot = self._plots.get(title)
        if plot is not None and len(plot.data) == len(data):
            plot.data = data
            return
        if plot is not None:
            plot.remove()
        series = [{"label": called(name), "stroke": stroke, "width": 2} for name, stroke in zip(values, _STROKES * 9)]
        with self._folder:
            self._plots[title] = self._gui.add_uplot(
                data, ({"label": "step"}, *series), title=title, scales={"x": {"time": False}}, aspect=1.5
            )
