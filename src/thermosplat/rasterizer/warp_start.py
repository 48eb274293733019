"""Starting Warp: without a needless warning, and, with a step's kernels compiled, while other things are done."""

import os
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TYPE_CHECKING

import warp as wp

from thermosplat.torch_bridge import kernel_cache
from warp_kernels.machinery.loading import KernelCacheError

if TYPE_CHECKING:
    from thermosplat.config import TrainConfig

EXPECTED_WITHOUT_CUDA = b"Could not find or load the NVIDIA CUDA driver"


def start_warp() -> None:
    """Initialise Warp, without the warning that its native library prints where there is no NVIDIA driver.

    The commands say themselves that there is no CUDA device; everything else it prints stays.

    The warning comes from C and is written to the file descriptor, where Python cannot filter it: standard error goes
    through a file meanwhile.

    Raises:
        UserError: The folder for compiled kernels cannot be made, as where the home directory is read-only.
    """
    wp.config.log_level = wp.LOG_WARNING  # no banner with versions and devices
    sys.stderr.flush()
    saved = os.dup(2)
    with tempfile.TemporaryFile() as printed:
        try:
            os.dup2(printed.fileno(), 2)
            kernel_cache.start_warp()
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            printed.seek(0)
            for line in printed:
                if EXPECTED_WITHOUT_CUDA not in line:
                    os.write(2, line)


@contextmanager
def started_meanwhile(config: "TrainConfig") -> Iterator[None]:
    """Around imports and the reading of images, none of which may use Warp: it is ready when they are done.

    The CUDA driver takes a while to start and leaves Python to others meanwhile. Where the training will run on the
    CPU, its kernels are compiled as well, which is said where the cache lacks some. On CUDA, which kernels blend
    depends on the frame.

    Args:
        config: The training's. Gaussians of one spectrum each have kernels of their own, compiled when they are needed.

    Raises:
        UserError: As :func:`start_warp`.
    """
    with ThreadPoolExecutor(max_workers=1) as thread:
        starting = thread.submit(_start, config)
        yield
        starting.result()


def _start(config: "TrainConfig") -> None:
    """Start Warp, and compile the kernels of a training on the CPU."""
    start_warp()
    on_cpu = config.device == "cpu" or (config.device == "auto" and wp.get_cuda_device_count() == 0)
    model = config.model
    if not on_cpu or model.gaussian_sets != "shared" or model.feature_dim == 0:
        return
    from warp_kernels.step_kernels import compile_for_cpu, cpu_step_kernels, must_compile_for_cpu

    decoupled = any(spectrum.opacity != "shared" for spectrum in list(config.modelled.values())[1:])
    thermal_channels = model.feature_dim if decoupled else 0
    kernels = cpu_step_kernels(3 + model.feature_dim, thermal_channels)
    try:
        if must_compile_for_cpu(kernels):
            print("Compiling kernels, once per machine (half a minute on two cores) ...", flush=True)
        compile_for_cpu(kernels)
    except KernelCacheError as error:
        raise kernel_cache.cache_error(error) from error
