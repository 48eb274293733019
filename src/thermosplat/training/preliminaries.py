"""Scenes that come before the one that is the result: those on which cameras are found, those that become one."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from thermosplat.runs.checkpoint import SavedTraining
from thermosplat.training.joined_scenes import Scene, seed_of_scene


@dataclass
class Preliminaries:
    """Which of the scenes of a training is under way."""

    seed_of_run: int
    """What random numbers of the first scene come from."""
    camera_passes: int = 0
    """Passes that are to find the cameras of the other spectra, with the one under way. After each of them the scene
    starts anew; 0: it is trained with these cameras."""
    scenes_left: int = 0
    """Scenes that are to be trained before all become one, with the one under way; 0: there is one."""
    kept_scenes: tuple[Scene, ...] = ()
    """Those that are trained, in the host's memory. Of ranks that share the model only the first has them; the others
    hold empty ones in their place."""

    @property
    def find_cameras(self) -> bool:
        """Whether the scene is to start anew, with the cameras that are found on it."""
        return self.camera_passes > 0

    @property
    def under_way(self) -> bool:
        """Whether the scene is to start anew, for whatever reason: it is no result of the run."""
        return self.find_cameras or self.scenes_left > 1

    @property
    def seed(self) -> int:
        """What the random numbers of the scene under way come from."""
        return seed_of_scene(self.seed_of_run, len(self.kept_scenes))

    def go_on(self, kept: Sequence[Scene]) -> None:
        """Start the next scene.

        Args:
            kept: Scenes that are trained and are to become one with those to come.
        """
        self.camera_passes = max(self.camera_passes - 1, 0)
        self.scenes_left -= len(kept) - len(self.kept_scenes)
        self.kept_scenes = tuple(kept)

    def end(self) -> None:
        """Let the scene under way be the result."""
        self.kept_scenes, self.scenes_left = (), 0

    def state_dict(self) -> dict[str, Any]:
        """The entries of ``SavedTraining``."""
        return {
            "camera_passes": self.camera_passes,
            "scenes_left": self.scenes_left,
            "kept_scenes": tuple({name: dict(packed) for name, packed in scene.items()} for scene in self.kept_scenes),
        }

    def load_state_dict(self, saved: SavedTraining) -> None:
        """The inverse of ``state_dict``."""
        self.camera_passes, self.scenes_left = saved.camera_passes, saved.scenes_left
        self.kept_scenes = tuple(saved.kept_scenes)
