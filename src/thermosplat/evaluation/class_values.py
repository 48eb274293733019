"""Measured values by class: what other spectra see where a spectrum tells which class a pixel belongs to."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

if TYPE_CHECKING:
    from thermosplat.evaluation.held_out import RenderedView

ByClass = dict[str, dict[str, dict[str, dict[str, Any]]]]
"""By the spectrum of classes, class and measuring spectrum: "unit", "pixels", "mean", "deviation", "lowest" and
"highest"."""


class ClassValues:
    """What spectra of one camera measure by the classes that another one tells, both as they were rendered."""

    def __init__(self) -> None:
        self._values: dict[tuple[str, str, str], list[Tensor]] = {}
        self._units: dict[str, str] = {}

    def add(self, views: "Sequence[RenderedView]") -> None:
        """Take over the values of a frame."""
        for labelled in views:
            formation = labelled.formation
            if formation is None or not formation.classes:
                continue
            numbers = formation.classes_in(labelled.image)
            for view in views:
                if view.scale.measured_unit is None or view.measured is None or view.measured.shape != numbers.shape:
                    continue
                if not torch.equal(view.camera.viewmat, labelled.camera.viewmat):
                    continue
                self._units[view.spectrum] = view.scale.measured_unit
                for number, name in enumerate(formation.classes):
                    found = view.measured[numbers == number].double()
                    self._values.setdefault((labelled.spectrum, name, view.spectrum), []).append(found.cpu())

    def numbers(self) -> ByClass:
        """The statistics over all frames, of classes that were seen."""
        report: ByClass = {}
        for (labelled, name, spectrum), parts in self._values.items():
            values = torch.cat(parts)
            if len(values):
                report.setdefault(labelled, {}).setdefault(name, {})[spectrum] = {
                    "unit": self._units[spectrum],
                    "pixels": len(values),
                    "mean": values.mean().item(),
                    "deviation": values.std(correction=0).item(),
                    "lowest": values.min().item(),
                    "highest": values.max().item(),
                }
        return report
