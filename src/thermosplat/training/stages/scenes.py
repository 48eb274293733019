"""Scenes that start anew, and scenes that are trained apart and become one (joined_scenes.py)."""

from collections.abc import Sequence
from dataclasses import replace

from thermosplat.config import OptimizerConfig
from thermosplat.scene.gaussians import Gaussians
from thermosplat.stop_signals import deferred_interrupts
from thermosplat.training.joined_scenes import Scene, joined_sets, kept_scene, seed_of_scene, steps_of_scene
from thermosplat.training.new_scenes import of_passes
from thermosplat.training.session.safekeeping import Safekeeping
from thermosplat.training.session.training_parts import Training
from thermosplat.training.sharing.shares import count_anew, divided_sets
from thermosplat.training.step_kind import Stage


class Beginnings:
    """How scenes of a training begin.

    Args:
        keeping: Saves the first state of each; checkpoints of the scene before go.

    Attributes:
        stages: The training's, which get ready for each scene.
    """

    def __init__(self, training: Training, keeping: Safekeeping) -> None:
        self._training, self._keeping = training, keeping
        self.stages: Sequence[Stage] = ()

    def start_anew(self, why: str, kept: Sequence[Scene] = ()) -> None:
        """Forget the scene; begin from the capture's points, with the cameras that were found.

        Args:
            kept: Scenes that are trained and are to become one with those to come.
        """
        training = self._training
        with deferred_interrupts():
            training.steps.forget(kernels=True)
            self.forget_scene(kept)
            self.begin_scene()
            if training.team.is_first:
                training.logger.start_again()
            training.say(why)
            saved = self._keeping.save()
            if training.team.is_first:
                for found_so_far in training.run.checkpoints():  # of more steps, and would be resumed from
                    if found_so_far != saved:
                        found_so_far.unlink(missing_ok=True)

    def forget_scene(self, kept: Sequence[Scene] = ()) -> None:
        """Put a new scene in place of the one under way."""
        config, state = self._training.config, self._training.state
        start = of_passes(config) if state.preliminaries.camera_passes > 1 else config
        model = self._training.scenes.made(replace(start, seed=seed_of_scene(config.seed, len(kept))))
        if kept:
            model.formations.load_state_dict(state.model.formations.state_dict())
        state.start_anew(model, kept)
        count_anew(self._training.team, state)

    def begin_scene(self) -> None:
        """Take the frames in the scene's order, and withhold those that it withholds."""
        self._training.schedule.shuffle(self._training.state.preliminaries.seed)
        for stage in self.stages:
            stage.begin_scene()


class SceneStage(Stage):
    """Several scenes, of which the last that start are all of them in one."""

    def __init__(self, training: Training, beginnings: Beginnings, keeping: Safekeeping) -> None:
        super().__init__(training)
        self._beginnings, self._keeping = beginnings, keeping

    def begin_scene(self) -> None:
        """Let lines say which scene it is."""
        config, scenes, logger = self.training.config, self.training.state.preliminaries, self.training.logger
        number, left = len(scenes.kept_scenes) + 1, scenes.scenes_left
        logger.scene = f"scene {number} of {config.scenes}: " if left > 0 else ""
        logger.steps_of_others = max(left - 1, 0) * steps_of_scene(config)

    def rates(self, rates: OptimizerConfig) -> OptimizerConfig:
        """Leave decoders as they are: scenes that become one have the same ones."""
        return replace(rates, decoders_lr=0.0) if self.training.state.preliminaries.kept_scenes else rates

    def acts_at(self, step: int) -> bool:
        """Where the scene under way is one of several, and as far as it comes by itself."""
        scenes = self.training.state.preliminaries
        return scenes.scenes_left > 0 and not scenes.find_cameras and step >= steps_of_scene(self.training.config)

    def leave(self) -> None:
        """Keep the scene and start another one, or let all become one. Until that is done the state is as it was."""
        training, state, scenes = self.training, self.training.state, self.training.config.scenes
        if not self.acts_at(state.step):
            return
        kept = [*state.preliminaries.kept_scenes, self._scene_to_keep()]
        if state.preliminaries.scenes_left > 1:
            said = f"Scene {len(kept)} of {scenes} is trained; the next one starts anew."
            self._beginnings.start_anew(said, kept)
            return
        sets = self.joined(kept)
        with deferred_interrupts():
            training.steps.forget(kernels=True)
            state.take(sets)
            state.preliminaries.end()
            count_anew(training.team, state)
            self._beginnings.begin_scene()
        training.say(f"All {scenes} scenes become one of {training.state.all_gaussians:,} Gaussians.")

    def _scene_to_keep(self) -> Scene:
        """The whole scene, on rank 0; the others hold its place."""
        if self.training.team.is_alone:
            return kept_scene(self.training.state.model)
        whole = self._keeping.gathered(training=False)
        return {} if whole is None else whole.model.gaussian_sets

    def joined(self, scenes: Sequence[Scene]) -> dict[str, Gaussians]:
        """This rank's share of the Gaussians of all scenes."""
        training, team, shares = self.training, self.training.team, list[dict[str, Gaussians]]()

        def join() -> None:
            sets = joined_sets(scenes, training.config, training.state.model.formations)
            shares.extend(divided_sets(sets, team.size))

        team.asked_of_first(join)
        share: dict[str, Gaussians] = team.dealt(shares if team.is_first else None)
        return share
