"""A matrix on disk: which of its cells are finished, and the processes that make the others."""

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from thermosplat.config import TrainConfig
from thermosplat.config.checks import check_config
from thermosplat.config.files import to_yaml
from thermosplat.config.run_schedule import run_schedule
from thermosplat.errors import UserError
from thermosplat.method_matrix.cell_result import CellResult
from thermosplat.method_matrix.cells import Cell, Scene, cell_config, difference, settings
from thermosplat.method_matrix.overrides import Override
from thermosplat.method_matrix.processes import Job, python_command
from thermosplat.runs.atomic_writes import plain_folder, write_text

CONFIG_FILE = "cell.yaml"
LOG_FILE = "cell.log"
CELL_MODULE = "thermosplat.cli.benchmark_cell"


@dataclass(frozen=True)
class Matrix:
    """Methods times scenes times seeds, in a folder."""

    out: Path
    scenes: Sequence[Scene]
    methods: Mapping[str, str]
    """Preset or YAML file by the method's name."""
    seeds: Sequence[int] = (42,)
    max_steps: int | None = None
    """Steps of a method that has 30,000, others in proportion."""
    save_every: int = 0
    """Steps between checkpoints; 0: only the last step's."""
    data_factor: int = 1
    """Divide the images' width and height by this."""
    overrides: Sequence[Override] = ()
    lpips_weights: str | None = None
    keep_checkpoints: bool = True

    def cells(self) -> list[Cell]:
        """All cells, scene by scene, so that the tables are complete for some scenes early."""
        return [
            Cell(scene.name, method, seed) for seed in self.seeds for scene in self.scenes for method in self.methods
        ]

    def config(self, cell: Cell) -> TrainConfig:
        """The configuration of a cell.

        Raises:
            UserError: An override does not fit it, or a value is one that no run can work with.
        """
        config = cell_config(
            self.methods[cell.method],
            next(scene for scene in self.scenes if scene.name == cell.scene),
            cell.seed,
            max_steps=self.max_steps,
            save_every=self.save_every,
            data_factor=self.data_factor,
            lpips_weights=self.lpips_weights,
        )
        for override in self.overrides:
            if override.concerns(cell):
                config = override.applied(config)
        check_config(config, source=str(cell))
        return config

    def missing(self, finished: Mapping[Cell, CellResult]) -> list[Cell]:
        """The cells that are not finished.

        Args:
            finished: The cells that are, here or on another machine.

        Raises:
            UserError: If one is finished with other settings.
        """
        missing = []
        for cell in self.cells():
            if cell not in finished:
                missing.append(cell)
            elif differing := difference(finished[cell].settings, settings(self.config(cell))):
                message = f"{cell} is finished with {differing}."
                raise UserError(message, f"Give another --out, or delete {cell.folder(self.out)} or what was merged.")
        return missing

    def longest_first(self, cells: Sequence[Cell], finished: Mapping[Cell, CellResult]) -> list[Cell]:
        """Cells by the time that their training may take, so that no device is left with a long one at the end.

        A step is taken to last as long as those of the method's finished cells, or of all finished ones where it has
        none. Cells of equal length keep their order.
        """
        times: dict[str, list[float]] = {}
        for cell, result in finished.items():
            times.setdefault(cell.method, []).append(result.train_minutes / result.steps)
        of_any = statistics.fmean(chain.from_iterable(times.values())) if times else 1.0

        def expected(cell: Cell) -> float:
            of_method = times.get(cell.method)
            return run_schedule(self.config(cell)).max_steps * (statistics.fmean(of_method) if of_method else of_any)

        return sorted(cells, key=expected, reverse=True)

    def job(self, cell: Cell) -> Job:
        """The process that makes a cell; writes the configuration that it reads."""
        folder = plain_folder(self.out, *cell.folder(Path()).parts)
        write_text(folder / CONFIG_FILE, to_yaml(self.config(cell)))
        words = ["--folder", str(folder), "--scene", cell.scene, "--method", cell.method, "--seed", str(cell.seed)]
        keep = "--keep-checkpoint" if self.keep_checkpoints else "--no-keep-checkpoint"
        return Job(str(cell), python_command(CELL_MODULE, *words, keep), folder / LOG_FILE)
