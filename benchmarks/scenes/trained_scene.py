"""A trained scene as a benchmark scene: from a run's folder, one of its checkpoints, or an exported PLY."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from scenes.benchmark_scenes import BenchmarkScene, shifted
from thermosplat.errors import UserError

SH_COEFFICIENTS = 16


def trained_scene(path: Path, data: str | None = None) -> BenchmarkScene:
    """Trained Gaussians, seen by a camera of the capture they were trained on.

    Args:
        path: result folder of thermosplat-train, a checkpoint in it, or a PLY of thermosplat-export.
        data: where the capture lies now; None: where it lay when the run was trained. A PLY has a camera only if this
            is given. Without a capture the Gaussians are seen from a distance, along the z axis.

    Returns:
        The scene. What the file does not hold (second opacities, features) is drawn at random; of several sets of
        Gaussians, and of several second opacities, the first is taken.
    """
    if path.suffix == ".ply":
        return _ply_scene(path, data)
    from thermosplat.evaluation.loaded_run import load_run
    from thermosplat.runs.run_directory import checkpoint_step

    folder, step = (path, None) if path.is_dir() else (path.parent.parent, checkpoint_step(path))
    run = load_run(str(folder), step=step, device="cpu")
    gaussians = run.model.gaussians(next(iter(run.model.gaussian_sets)))
    coefficients = torch.cat(gaussians.sh_coeffs, 1).detach()
    sh = coefficients.new_zeros(len(gaussians), SH_COEFFICIENTS, 3)
    sh[:, : coefficients.shape[1]] = coefficients[:, :SH_COEFFICIENTS]
    means, opacities = gaussians.means.detach().contiguous(), gaussians.opacities.detach().contiguous()
    thermal = opacities
    for spectrum in gaussians.second_opacities[:1]:
        thermal = gaussians.opacities_in(spectrum).detach().contiguous()
    try:
        viewmat, K = _capture_camera(run.capture(data))
    except UserError as error:
        print(f"{error}: {path} is seen from a distance instead", flush=True)
        viewmat, K = distant_camera(means)
    return BenchmarkScene(
        f"trained {folder.name}",
        means,
        gaussians.quats.detach(),
        gaussians.scales.detach(),
        opacities,
        shifted(opacities) if torch.equal(thermal, opacities) else thermal,
        sh,
        viewmat,
        K,
        gaussians.expanded(gaussians.features).detach() if gaussians.has_features else None,
    )


def _ply_scene(path: Path, data: str | None) -> BenchmarkScene:
    columns = read_ply(path)

    def stacked(*names: str) -> Tensor:
        return torch.stack([columns[name] for name in names], -1)

    means = stacked("x", "y", "z")
    rest = stacked(*(f"f_rest_{i}" for i in range(3 * (SH_COEFFICIENTS - 1))))
    rest = rest.reshape(len(means), 3, SH_COEFFICIENTS - 1).transpose(1, 2)
    if data is not None:
        from thermosplat.datasets import load_capture

        viewmat, K = _capture_camera(load_capture(data))
    else:
        viewmat, K = distant_camera(means)
    opacities = torch.sigmoid(columns["opacity"])
    return BenchmarkScene(
        f"trained {path.stem}",
        means,
        stacked(*(f"rot_{i}" for i in range(4))),
        torch.exp(stacked(*(f"scale_{i}" for i in range(3)))),
        opacities,
        shifted(opacities),
        torch.cat([stacked(*(f"f_dc_{i}" for i in range(3)))[:, None], rest], 1).contiguous(),
        viewmat,
        K,
    )


def read_ply(path: Path) -> dict[str, Tensor]:
    """The columns of a PLY of Gaussians: one element of float32 properties, binary little endian.

    Args:
        path: as thermosplat-export and 3DGS write it.

    Returns:
        float32 [N] for each property.

    Raises:
        ValueError: if the file is of another kind.
    """
    with path.open("rb") as file:
        header: list[str] = []
        while not header or header[-1] != "end_header":
            line = file.readline()
            if not line:
                raise ValueError(f"{path} is no PLY: its header does not end")
            header.append(line.decode("ascii", errors="replace").strip())
        names = [line.split()[-1] for line in header if line.startswith("property float ")]
        elements = [line.split() for line in header if line.startswith("element ")]
        others = [line for line in header if line.startswith("property ") and not line.startswith("property float ")]
        if "format binary_little_endian 1.0" not in header or len(elements) != 1 or others:
            raise ValueError(f"{path} is not a binary little endian PLY with one element of float properties")
        count = int(elements[0][2])
        table = np.fromfile(file, dtype="<f4", count=count * len(names)).reshape(count, len(names))
    return {name: torch.from_numpy(table[:, i].astype(np.float32)) for i, name in enumerate(names)}


def _capture_camera(capture: object) -> tuple[Tensor, Tensor]:
    """Pose, and intrinsics for a width and height of 1, of the middle training frame."""
    frames = capture.train  # type: ignore[attr-defined]
    frame = frames[len(frames) // 2]
    view = next(iter(frame.views.values()))
    K = torch.from_numpy(view.camera.resized(1, 1).K).float()
    return torch.from_numpy(view.viewmat).float(), K


def distant_camera(means: Tensor) -> tuple[Tensor, Tensor]:
    """A camera on the z axis through the median of the Gaussians, from which half of them fill most of the image.

    Args:
        means: [N, 3].

    Returns:
        Pose [4, 4], and intrinsics [3, 3] for a width and height of 1.
    """
    centre = means.median(0).values
    radius = (means - centre).norm(dim=-1).median()
    viewmat = torch.eye(4)
    viewmat[:3, 3] = -centre
    viewmat[2, 3] += 2.0 * radius
    return viewmat, torch.tensor([[0.9, 0, 0.5], [0, 1.2, 0.5], [0, 0, 1]])
