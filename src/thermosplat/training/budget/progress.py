"""How far ``--budget auto`` has come with the scene under way."""

import math
from dataclasses import dataclass
from typing import Any

from thermosplat.runs.checkpoint import SavedTraining


@dataclass
class BudgetProgress:
    """What a budget has ended, left out and seen. Without a budget it stays as it is at first."""

    growing: bool = True
    """Whether density control may still add Gaussians."""
    offsets_dropped: bool = False
    """Whether opacity offsets that are zero stay zero."""
    due: tuple[str, ...] = ()
    """What is to be left out after the step done and is not left out yet: memory ended before."""
    trimmed: bool = False
    """Whether what the training images do not miss was dropped after the last step (``AutoBudget.finish``)."""
    best_validation: tuple[float, int] = (-math.inf, 0)
    """Best PSNR of withheld training views so far [dB], and its step."""

    def state_dict(self) -> dict[str, Any]:
        """The entries of ``SavedTraining``."""
        return {
            "growing": self.growing,
            "offsets_dropped": self.offsets_dropped,
            "budget_due": self.due,
            "trimmed": self.trimmed,
            "best_validation": self.best_validation,
        }

    @classmethod
    def of_checkpoint(cls, saved: SavedTraining) -> "BudgetProgress":
        """The inverse of ``state_dict``."""
        return cls(saved.growing, saved.offsets_dropped, saved.budget_due, saved.trimmed, saved.best_validation)
