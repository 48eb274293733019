"""Results of cells that nobody trained."""

from typing import Any

from thermosplat.method_matrix.cell_result import CellResult


def made_cell(scene: str = "lab", method: str = "3dgs", seed: int = 42, **changes: Any) -> CellResult:
    """A cell whose numbers depend on what it is called."""
    psnr = 20.0 + len(method) + seed / 100
    values: dict[str, Any] = {
        "scene": scene,
        "method": method,
        "seed": seed,
        "steps": 30,
        "rgb": {"psnr": psnr, "ssim": 0.9, "lpips": None},
        "thermal": {"psnr": psnr + 1, "ssim": 0.95, "lpips": None, "mae_celsius": 0.25},
        "num_gaussians": 1234,
        "model_bytes": 2_500_000,
        "train_minutes": 1.5,
        "peak_memory_bytes": 2**30,
        "frames_per_second": 100.0,
        "device": "a device",
        "lpips_net": None,
        "settings": {"max_steps": 30, "loss": {"rgb": 1.0}},
        "per_view": [{"frame": "f0", "modality": "rgb", "psnr": psnr, "ssim": 0.9, "lpips": None}],
    }
    return CellResult(**{**values, **changes})
