"""What of the Gaussians is trained in the host's memory: ``--offload`` and what it needs."""

from typing import Literal, NamedTuple

import torch

from thermosplat.config import TrainConfig
from thermosplat.datasets.host_memory import host_memory
from thermosplat.errors import UserError
from thermosplat.scene.model import SceneModel
from thermosplat.scene.offloaded import can_be_offloaded
from thermosplat.torch_bridge.host_rows import row_length

Offloaded = Literal["nothing", "moments", "all"]
"""What lies in the host's memory of the parameters that can: nothing, their moments, or they and their moments."""
STEP_BYTES = 36
"""A Gaussian's part of what a step holds beside parameters, gradients, moments and density control, measured
(docs/scaling.md)."""
OBSERVED_BYTES = 8
"""What density control keeps of a Gaussian."""
SHARE_OF_DEVICE = 0.8
"""Of the device's memory that Gaussians may take: images, decoders and lists of pairs need the rest. Open choice."""
SHARE_WITH_MOMENTS = 0.88
"""Of the device's memory that Gaussians may take with moments that can go to the host's memory when a step needs more.
2 million Gaussians in view at 1280x1024 take 1.4 GB, which is 0.09 of 15 GB (benchmarks/notes/offload.md). Open
choice."""
SHARE_OF_HOST = 0.5
"""Of the host's memory that offloaded parameters may take: images and checkpoints need it too. Open choice."""
_GB = 1e9


def refused(config: TrainConfig, *, divided: bool = False) -> str | None:
    """Why a training cannot offload, in one sentence; None: it can."""
    if divided:
        return "--offload works on one device, and this training is divided over several."
    if (config.batch_size or 1) > 1:
        return f"--offload works with one frame per step, and --batch-size is {config.batch_size}."
    if config.loss.feature_norm > 0:
        return "--offload cannot hold all features near unit length, as --loss.feature-norm asks for."
    return None


class Decision(NamedTuple):
    """What to offload."""

    kind: Offloaded
    note: str | None = None
    """A line that says so, where there is something to say."""
    rows_on_device: dict[str, int] | None = None
    """By set, the first Gaussians whose moments are on the device nevertheless; None: of no Gaussian."""


def decided(config: TrainConfig, model: SceneModel, device: torch.device, *, divided: bool = False) -> Decision:
    """What to offload.

    Args:
        model: The model at the start of the training or as it was resumed, anywhere.

    Raises:
        UserError: It is asked for where it does not work.
    """
    if config.offload == "off":
        return Decision("nothing")
    why, most = refused(config, divided=divided), config.scenes * (config.densification.max_gaussians or 0)
    sizes = {name: SetSize.of(model, name, most) for name in model.gaussian_sets}
    if why is None and not any(size.movable for size in sizes.values()):
        why = "--offload found nothing to offload: there are no features and no spherical harmonics above degree 0."
    growing = config.densification.stop_step > config.densification.start_step
    if config.offload != "auto":
        if why is not None:
            raise UserError(why, "Leave --offload out.")
        return _said(f"--offload {config.offload}", "all" if config.offload == "on" else "moments", sizes, growing)
    if why is not None or device.type != "cuda":
        return Decision("nothing")
    free = free_device_memory(device, config.gpu_memory)
    whole = _on_device("nothing", sizes, growing)
    if whole <= SHARE_OF_DEVICE * free:
        return Decision("nothing")
    number = sum(size.number for size in sizes.values())
    needs = f"{number:,} Gaussians need {whole / _GB:.1f} GB, and {free / _GB:.1f} GB of the GPU are free"
    kind: Offloaded = "moments" if _on_device("moments", sizes, growing) <= SHARE_OF_DEVICE * free else "all"
    on_host = sum(size.on_host(kind, growing) for size in sizes.values())
    if on_host > SHARE_OF_HOST * host_memory():
        line = f"{needs}. The host has not the {on_host / _GB:.1f} GB that --offload would put there."
        return Decision("nothing", line)
    # A refinement brings moments to the host's memory before it copies anything: steps alone count
    left = SHARE_WITH_MOMENTS * free - _on_device(kind, sizes, False)
    moments = sum(size.number * size.moment_bytes for size in sizes.values())
    return _said(needs, kind, sizes, growing, min(max(left / moments, 0.0), 1.0))


def _on_device(kind: Offloaded, sizes: "dict[str, SetSize]", growing: bool) -> float:
    return sum(size.on_device(kind, growing) for size in sizes.values())


def _said(why: str, kind: Offloaded, sizes: "dict[str, SetSize]", growing: bool, near: float = 0.0) -> Decision:
    """A decision in a sentence; moments of a share ``near`` of the Gaussians are on the device."""
    on_host = sum(size.on_host(kind, growing) for size in sizes.values()) / _GB
    rows = {name: int(near * size.number) for name, size in sizes.items()}
    moments = sum(count * sizes[name].moment_bytes for name, count in rows.items())
    on_device = max(_on_device(kind, sizes, growing), _on_device(kind, sizes, False) + moments) / _GB
    what = "Spherical harmonics, features and their moments" if kind == "all" else "Moments of harmonics and features"
    but = f", between refinements those of {near:.0%} of the Gaussians on the device" if any(rows.values()) else ""
    line = (
        f"{why}. {what} lie in the host's memory{but}: up to {on_host:.1f} GB there, {on_device:.1f} GB on the device. "
        "Adam updates them where Gaussians are in view."
    )
    return Decision(kind, line, rows if any(rows.values()) else None)


class SetSize(NamedTuple):
    """How large a set of Gaussians is, or becomes."""

    number: int
    """Gaussians."""
    floats: int
    """Numbers of each."""
    movable: int
    """Those of them that can be offloaded."""
    padded: int
    """As many as these take in the host's memory, where rows are padded."""

    @classmethod
    def of(cls, model: SceneModel, name: str, most: int = 0) -> "SetSize":
        """Of a model's set, which grows to so many Gaussians.

        Args:
            most: Gaussians; fewer than there are have no effect.
        """
        gaussians = model.gaussians(name)
        parameters = dict(gaussians.named_parameters())
        each = {key: value[0].numel() if len(value) else 0 for key, value in parameters.items()}
        movable = [key for key in parameters if can_be_offloaded(key, parameters[key])]
        padded = sum(row_length(parameters[key]) for key in movable)
        return cls(max(len(gaussians), most), sum(each.values()), sum(each[key] for key in movable), padded)

    @property
    def moment_bytes(self) -> int:
        """Bytes of a Gaussian's moments that can be offloaded, wherever they lie."""
        return 8 * self.padded

    def on_device(self, kind: Offloaded, growing: bool) -> float:
        """Bytes on the device.

        Args:
            growing: Also of a refinement, which copies parameters and moments; else of a step.
        """
        here = self.floats if kind == "nothing" else self.floats - self.movable
        alone = self.movable if kind == "moments" else 0  # parameters whose moments are elsewhere
        in_step = 16 * here + 4 * alone + STEP_BYTES + OBSERVED_BYTES
        return self.number * (max(in_step, 24 * here) if growing else in_step)

    def on_host(self, kind: Offloaded, growing: bool) -> float:
        """Bytes in the host's memory.

        Args:
            growing: As in ``on_device``; of a refinement, which has parameters there, too.
        """
        if kind == "nothing":
            return 0.0
        in_step = (8 if kind == "moments" else 12) * self.padded
        return self.number * (24 * self.padded if growing else in_step)


def limit_device_memory(device: torch.device, gigabytes: float) -> None:
    """Let this process take no more of a CUDA device's memory than this.

    Args:
        gigabytes: The limit [GB]. What CUDA itself takes, some hundred megabytes, comes on top.
    """
    total = torch.cuda.get_device_properties(device).total_memory
    torch.cuda.set_per_process_memory_fraction(min(1.0, gigabytes * _GB / total), device)


def free_device_memory(device: torch.device, gigabytes: float | None) -> float:
    """Memory of a CUDA device that this process may still take [bytes].

    Args:
        gigabytes: The limit, as of ``limit_device_memory``; None: there is none.
    """
    free, total = torch.cuda.mem_get_info(device)
    reserved = torch.cuda.memory_reserved(device)
    allowed = total if gigabytes is None else gigabytes * _GB
    return min(free, allowed - reserved) + reserved - torch.cuda.memory_allocated(device)
