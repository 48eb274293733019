"""What a training makes of its model: evaluations of held-out views, and the files of a finished run."""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import torch

from thermosplat.datasets.capture import Capture
from thermosplat.evaluation.held_out_poses import Judged, evaluate_refined
from thermosplat.evaluation.labelled_regions import write_regions
from thermosplat.evaluation.training_views import remarks, training_views
from thermosplat.export.export_frame import ExportFrame
from thermosplat.export.scene import scene_splats, write_scene
from thermosplat.image_quality.lpips import Lpips, find_lpips
from thermosplat.refinement.camera_report import write_cameras
from thermosplat.refinement.corrected_capture import corrected_capture
from thermosplat.scene.model import SceneModel
from thermosplat.training.session.checkpoint_writer import going_on_without, naming_the_newest_checkpoint
from thermosplat.training.session.interruption import meanwhile
from thermosplat.training.session.run_metrics import run_metrics
from thermosplat.training.session.safekeeping import Safekeeping, given
from thermosplat.training.session.training_parts import Training
from thermosplat.training.sharing.meetings import Meetings
from thermosplat.training.step_kind import sh_degree_at


class RunResults:
    """Evaluates the model of a training, and writes what a finished run leaves behind.

    On several ranks rank 0 does it, with the whole model, while the others wait.

    Args:
        training: Whatever its model is at the time of a call is evaluated.
        keeping: Gathers the whole model.
    """

    def __init__(self, training: Training, keeping: Safekeeping, meetings: Meetings) -> None:
        self._training, self._keeping, self._meetings = training, keeping, meetings
        self._config, self._capture, self._run = training.config, training.capture, training.run
        self._state, self._device = training.state, training.team.device
        self._lpips: Lpips | None = None

    def with_whole(self, work: Callable[[], Any]) -> Any:
        """Let rank 0 do something with the whole model, which it holds meanwhile; what it gives, None on the others."""
        if self._training.team.is_alone:
            return work()
        whole = self._keeping.gathered(training=False)

        def done() -> Any:
            with self._state.showing(SceneModel.from_checkpoint(given(whole), self._device)):
                return work()

        found = self._meetings.by_first(done)
        if self._device.type == "cuda":
            torch.cuda.empty_cache()
        return found

    def evaluate_on_the_way(self) -> None:
        """Judge the model between two steps; training goes on where a file cannot be written."""

        def judge() -> None:
            with going_on_without(self._training.logger.say):
                self.evaluate()

        self.with_whole(judge)

    def leave_behind(self, started: float) -> dict[str, Any]:
        """Judge the model of a finished run, and write everything that the run leaves.

        Args:
            started: When it began, if it had one sitting (``time.perf_counter``) [s].

        Returns:
            The content of metrics.json; nothing on ranks that are not the first.
        """

        def write() -> dict[str, Any]:
            with naming_the_newest_checkpoint(self._run):
                with meanwhile(self.exporting()):
                    judged = self.evaluate(at_the_end=True)
                self._state.seconds.wall = time.perf_counter() - started
                metrics = self.write(judged)
            self._run.sweep()
            return metrics

        return self.with_whole(write) or {}

    def find_lpips(self) -> str:
        """Load what measures LPIPS, where its weights are at hand; a line that says so or says why not.

        Raises:
            UserError: the weights that were asked for cannot be read.
        """
        self._lpips, remark = find_lpips(self._config.lpips_weights, self._device)
        return remark

    def lack_evaluation(self) -> bool:
        """Whether the step done, one in the middle of the run, was to be evaluated and was not."""
        step, config = self._state.step, self._config
        due = 0 < step < config.max_steps and step in config.eval_steps and not self._state.preliminaries.under_way
        return due and not (self._run.stats / f"step_{step:06d}.json").is_file()

    def evaluate(self, *, at_the_end: bool = False) -> Judged:
        """Judge the model by the held-out views, say and write the numbers.

        Args:
            at_the_end: Also write strips and the numbers of every view, and look at training views beside them.
        """
        step = self._state.step
        judged = evaluate_refined(
            self._state.model,
            self.corrected_capture(),
            self._config,
            sh_degree=sh_degree_at(self._config, step),
            lpips=self._lpips,
            strips_dir=self._run.renders if at_the_end else None,
            csv_path=self._run.stats / "per_view.csv" if at_the_end else None,
        )
        if at_the_end:
            known = training_views(self._state.model, judged.capture, sh_degree=sh_degree_at(self._config, step))
            judged = replace(judged, metrics={**judged.metrics, "training_views": known})
            lines = remarks(judged.metrics, self._config.budget == "fixed")
            judged = replace(judged, metrics={**judged.metrics, "remarks": lines})
        self._training.logger.evaluation(step, judged.metrics)
        self._run.write_json(self._run.stats / f"step_{step:06d}.json", judged.metrics)
        return judged

    def corrected_capture(self) -> Capture:
        """The capture with its cameras as they are believed to be now."""
        corrections = self._state.corrections
        return self._capture if corrections is None else corrected_capture(self._capture, corrections)

    def exporting(self) -> Callable[[], object]:
        """What writes the scene for other viewers; in any thread, as it has tensors of its own."""
        model = self._state.model
        frame = ExportFrame(model.placement, self._capture.geo)
        scene = scene_splats(model, self._capture.scales, frame=frame)
        return partial(write_scene, scene, self._run.ply, frame=frame)

    def write(self, judged: Judged) -> dict[str, Any]:
        """Write errors by region, corrected cameras and, last of all, metrics.json: where it is, everything is.

        Returns:
            The content of metrics.json.
        """
        state, config = self._state, self._config
        write_regions(self._run, state.model, judged.capture, state.step, sh_degree_at(config, state.step))
        if state.corrections is not None:
            write_cameras(judged.capture, self._run.refined)
        metrics = run_metrics(judged.metrics, state, self._device, self._lpips, config)
        self._run.write_json(self._run.metrics_json, metrics)
        return metrics
