"""A finished or interrupted run, read back for evaluation, rendering and export."""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from thermosplat.config import TrainConfig
from thermosplat.config.temperature_settings import TemperatureSettings, read_labels
from thermosplat.datasets import capture_of
from thermosplat.datasets.capture import Capture
from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.datasets.geo_file import GeoFrame, read_geo
from thermosplat.errors import UserError
from thermosplat.rasterizer.warp_start import start_warp
from thermosplat.refinement.camera_corrections import CameraCorrections
from thermosplat.refinement.corrected_capture import corrected_capture
from thermosplat.runs.checkpoint import damage_explained
from thermosplat.runs.checkpoint_file import load_checkpoint
from thermosplat.runs.devices import choose_device
from thermosplat.runs.run_directory import RunDirectory, checkpoint_step
from thermosplat.scene.model import SceneModel
from thermosplat.scene.saved_gaussians import num_not_finite
from thermosplat.spectra import BUILT_IN_PALETTES, CELSIUS, SpectrumConfig
from thermosplat.thermal.radiometry import PixelScale
from thermosplat.thermal.recalculation import Recalculation
from thermosplat.thermal.thermal_parameters import capture_parameters
from thermosplat.thermography.certainty import Certainty
from thermosplat.thermography.label_images import LabelImages
from thermosplat.thermography.measurements_file import FOLDER, MEASUREMENTS, read_scale
from thermosplat.thermography.scene_temperatures import SceneTemperatures


@dataclass(frozen=True)
class LoadedRun:
    """What a checkpoint holds, ready to render."""

    directory: RunDirectory
    """The result folder."""
    config: TrainConfig
    """The configuration it was trained with."""
    step: int
    """Training steps done."""
    sh_degree: int
    """Highest SH degree in use at that step."""
    model: SceneModel
    """The scene, on ``device``."""
    scales: dict[str, PixelScale]
    """What pixel values mean, by spectrum."""
    device: torch.device
    """Where the model is."""
    train_frames: list[str] | None
    """Names of the frames it was trained on; None where the checkpoint does not say."""
    test_frames: list[str] | None
    """Names of the frames it was to be judged by; None where the checkpoint does not say."""
    corrections: dict[str, Any] | None = None
    """What training found wrong with the cameras (``CameraCorrections``); None: nothing of them was refined."""
    notes: tuple[str, ...] = ()
    """What to say of the model before it is rendered."""

    def view(self, viewmat: NDArray[np.floating], K: NDArray[np.floating], width: int, height: int) -> ViewTensors:
        """A pinhole camera of one's own to render from.

        Args:
            viewmat: World to camera, OpenCV axes, [4, 4], in the world of the capture's own poses.
            K: Intrinsics [px], [3, 3].
            width: Image width [px].
            height: Image height [px].
        """
        in_scene = self.model.placement.viewmat_to_scene(viewmat)
        viewmat_, K_ = (torch.as_tensor(matrix, dtype=torch.float32, device=self.device) for matrix in (in_scene, K))
        return ViewTensors(viewmat_, K_, width, height)

    @cached_property
    def geo(self) -> GeoFrame | None:
        """Where the world of its capture lies on the Earth, as the capture said when it was trained on.

        Raises:
            UserError: geo.json in the result folder is damaged.
        """
        return read_geo(self.directory.path)

    def capture(self, data: str | None) -> Capture:
        """The capture it was trained on, with the cameras that training has corrected.

        Args:
            data: Where it lies now; None: where it lay.

        Returns:
            The capture; a note of it says so if its frames are not those of the run.

        Raises:
            UserError: It cannot be read there.
        """
        if data is None and self.config.data != "sample" and not Path(self.config.data).exists():
            raise UserError(
                f"{self.directory.path} was trained on {self.config.data}, which is not there.",
                "Say where it lies now: --data FOLDER.",
            )
        config = self.config
        with _files_at_hand(config.spectra, self.scales, self.model) as spectra:
            capture = capture_of(replace(config, data=str(data or config.data), spectra=spectra))
        capture = capture.placed(self.model.placement)
        difference = other_frames(self.train_frames, capture)
        if not difference and not self.is_own(capture):
            difference = f"{capture.root} has other held-out frames."
        if difference:
            name = self.result_name(capture)
            note = f"Is this the capture of {self.directory.path}? {difference} Results are named {name}."
            return replace(capture, notes=(*capture.notes, note))
        if self.corrections is None:
            return capture
        return corrected_capture(capture, self._corrections(capture, self.corrections))

    def temperatures(
        self,
        settings: TemperatureSettings | None = None,
        *,
        capture: Capture | None = None,
        metres_per_unit: float | None = None,
    ) -> SceneTemperatures:
        """How measured values are made of what the scene renders, recalculated if that is asked for.

        Args:
            settings: What is asked for; without a number of it temperatures stay as the capture has them, and can be
                recalculated later (``SceneTemperatures.asking``). None: they stay.
            capture: The run's capture (``capture``), whose folder says what was applied. Label images need it. None:
                the folder that it was trained from is looked at.
            metres_per_unit: Length of a unit of the capture's own poses [m]; None: that of a measured length
                (``RUN/measurements/measurements.json``), else nobody knows it.

        Raises:
            UserError: A setting is impossible, no spectrum has temperatures, or a file is damaged.
        """
        if settings is None:
            return SceneTemperatures(self.model, self.scales)
        settings.checked()
        if not any(scale.measured_unit == CELSIUS for scale in self.scales.values()):
            raise UserError(
                f"{self.directory.path} has no temperatures that could be recalculated.",
                "Train on thermal images with degrees: docs/temperatures.md.",
            )
        root = Path(self.config.data) if capture is None else capture.root
        labels_file = None if settings.labels is None else Path(settings.labels).expanduser()
        surfaces = {} if labels_file is None else read_labels(labels_file)
        made = Recalculation.of(capture_parameters(root), settings, surfaces)
        labels = {}
        if labels_file is not None:
            if capture is None:
                raise UserError("Label images lie in the pixels of the capture's images.", "Give the capture, too.")
            names = [name for name, scale in self.scales.items() if scale.measured_unit == CELSIUS]
            labels = {name: LabelImages(capture, self.model, name, labels_file, self.device) for name in names}
        if metres_per_unit is None:
            metres_per_unit = read_scale(self.directory.path / FOLDER / MEASUREMENTS)
        return SceneTemperatures(self.model, self.scales, made, metres_per_unit=metres_per_unit, labels=labels)

    def certainties(self, capture: Capture) -> dict[str, Certainty]:
        """How sure measured values are, by spectrum; found when it is first asked for, and kept in the run."""
        stats = self.directory.stats if self.directory.holds_a_run() else None
        name = self.result_name(capture)
        return {
            spectrum: Certainty(
                self.model,
                capture,
                spectrum,
                scale,
                sh_degree=self.sh_degree,
                device=self.device,
                keep=None if stats is None else stats / f"certainty_{spectrum}_{name}.json",
            )
            for spectrum, scale in self.scales.items()
            if scale.measured_unit is not None and any(spectrum in frame.views for frame in capture.train)
        }

    def _corrections(self, capture: Capture, learnt: dict[str, Any]) -> CameraCorrections:
        """What training found wrong with the cameras of its capture."""
        spectra = list(self.model.spectra)
        corrections = CameraCorrections(self.config.refine, capture, spectra)
        with damage_explained("corrections"):
            corrections.load_state_dict(learnt)
        return corrections

    def is_own(self, capture: Capture) -> bool:
        """Whether a capture has the frames that the run was trained on and is judged by, as far as it says."""
        splits = ((self.train_frames, capture.train), (self.test_frames, capture.test))
        return all(then is None or then == [frame.name for frame in now] for then, now in splits)

    def result_name(self, capture: Capture) -> str:
        """What results on a capture are called: by the step; on another one than the run's, by its name too."""
        return f"{self.step:06d}" if self.is_own(capture) else f"{self.step:06d}_{capture.name}"


def other_frames(then: list[str] | None, capture: Capture) -> str:
    """How a capture's training frames differ from those of a run.

    Args:
        then: Names of the frames that the run was trained on; None: it does not say, and they count as the same.

    Returns:
        A sentence, or "" if they are the same by number and name.
    """
    now = [frame.name for frame in capture.train]
    if then is None or then == now:
        return ""
    strange = [name for name in now if name not in set(then)] or [name for name in then if name not in set(now)] or now
    return (
        f"It was trained on {len(then)} frames, and {capture.root} has {len(now)} training frames "
        f"that are not the same (first difference: {strange[0]})."
    )


def load_run(folder: str, *, step: int | None = None, device: str = "auto") -> LoadedRun:
    """Read a run's checkpoint.

    Args:
        folder: The result folder.
        step: Which checkpoint. None: the one with the most steps.
        device: As ``--device``.

    Raises:
        UserError: No run, no such checkpoint, a damaged one, or no such device.
    """
    chosen = choose_device(device)
    directory = RunDirectory.open(folder)
    return _loaded(directory, _checkpoint(directory, step), chosen)


def load_run_of_checkpoint(file: Path, *, device: str = "auto") -> LoadedRun:
    """Read a checkpoint that may lie outside of a run.

    Args:
        file: The checkpoint. Its result folder is the one that it lies in: RUN of RUN/ckpts/FILE, else its own folder.
        device: As ``--device``.

    Raises:
        UserError: There is no such file, it is damaged or something else, or there is no such device.
    """
    chosen = choose_device(device)
    if not file.is_file():
        raise UserError(f"There is no checkpoint {file}.", "Give a result folder, or one of its ckpts/*.pt.")
    return _loaded(RunDirectory(file.parent.parent if file.parent.name == "ckpts" else file.parent), file, chosen)


def _loaded(directory: RunDirectory, file: Path, chosen: torch.device) -> LoadedRun:
    start_warp()
    checkpoint = load_checkpoint(file, chosen)
    with damage_explained("scales"):
        scales = {name: PixelScale.from_state_dict(scale) for name, scale in checkpoint.scales.items()}
        if lacking := checkpoint.config.modelled.keys() - scales.keys():
            raise KeyError(min(lacking))
    model = SceneModel.from_checkpoint(checkpoint, chosen).eval()
    return LoadedRun(
        directory=directory,
        config=checkpoint.config,
        step=checkpoint.step,
        sh_degree=checkpoint.sh_degree,
        model=model,
        scales=scales,
        device=chosen,
        train_frames=checkpoint.train_frames,
        test_frames=checkpoint.test_frames,
        corrections=checkpoint.training.corrections,
        notes=(*checkpoint.notes, *_notes(model)),
    )


@contextmanager
def _files_at_hand(
    spectra: Mapping[str, SpectrumConfig], scales: Mapping[str, PixelScale], model: SceneModel
) -> Iterator[dict[str, SpectrumConfig]]:
    """Spectra with palettes and bases that a run stored in place of its files, which may be on another machine."""
    with TemporaryDirectory() as folder:
        found = dict(spectra)
        for name, spectrum in spectra.items():
            if name in scales and spectrum.palette is not None and spectrum.palette not in BUILT_IN_PALETTES:
                path = Path(folder) / f"{name}.json"
                levels = scales[name].palette.colors.astype(np.float64) * 255  # as many digits as come back equal
                path.write_text(json.dumps({"lut": levels.tolist()}), encoding="utf-8")
                found[name] = replace(spectrum, palette=str(path))
            if name in model.spectra and (basis := model.formations[name].basis_of_images()) is not None:
                path = Path(folder) / f"{name}.npy"
                np.save(path, basis.numpy(force=True))
                found[name] = replace(spectrum, basis=str(path), range=scales[name].range)
        yield found


def _notes(model: SceneModel) -> tuple[str, ...]:
    """On values that are not finite."""
    notes = []
    for name in model.gaussian_sets:
        if broken := num_not_finite(model.gaussians(name)):
            number = len(model.gaussians(name))
            notes.append(
                f"{broken:,} of {number:,} Gaussians hold values that are not finite, and are not drawn. The "
                "checkpoint was damaged before it was written, or edited: take an earlier one with --step."
            )
    if not all(bool(torch.isfinite(value).all()) for value in model.formations.parameters()):
        notes.append("The decoders hold values that are not finite, and so will the images: take an earlier --step.")
    return tuple(notes)


def _checkpoint(directory: RunDirectory, step: int | None) -> Path:
    latest = directory.latest_checkpoint()
    if latest is None:
        raise UserError(f"{directory.path} has no checkpoint yet.", "Train it: see config.yaml there for its settings.")
    if step is None:
        return latest
    path = directory.checkpoint(step)
    if not path.is_file():
        steps = [checkpoint_step(file) for file in directory.checkpoints()]
        raise UserError(
            f"{directory.path} has no checkpoint of step {step}.", f"It has: {', '.join(f'--step {n}' for n in steps)}."
        )
    return path
