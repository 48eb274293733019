"""Renders from many threads for as long as asked for, as a server does, and says whether memory stays flat.

    python tests/faults/serve_for_long.py --seconds 3600 --threads 20
    python tests/faults/serve_for_long.py --seconds 600 --device cuda

Each thread renders views of all sizes of a scene that it shares with the others; every tenth is differentiated. What
the threads render of one view is compared to the last bit. Exit code 1: memory grew, or images differ.
"""

import argparse
import random
import resource
import sys
import threading
import time
from pathlib import Path

import torch

from thermosplat.rasterizer import rasterization_rgbt

SIZES = [(64, 48), (40, 30), (97, 61), (16, 16)]
"""Of the images [px]."""

WARM_UP = 0.25
"""Share of the time after which memory has to stay as it is."""

GROWTH = 32 * 2**20
"""Growth that is taken for noise of the allocators [bytes]."""


def scene(device: torch.device) -> dict[str, torch.Tensor]:
    """Random Gaussians in front of a camera."""
    generator = torch.Generator().manual_seed(0)
    count = 200
    values = {
        "means": torch.randn(count, 3, generator=generator),
        "quats": torch.randn(count, 4, generator=generator),
        "scales": 0.05 + 0.1 * torch.rand(count, 3, generator=generator),
        "opacities": torch.rand(count, generator=generator),
        "thermal_opacities": torch.rand(count, generator=generator),
        "colors": torch.randn(count, 16, 3, generator=generator),
        "features": torch.randn(count, 4, generator=generator),
    }
    return {name: value.to(device) for name, value in values.items()}


def render(values: dict[str, torch.Tensor], size: tuple[int, int], differentiate: bool) -> torch.Tensor:
    """One image, with a backward pass where it is asked for."""
    width, height = size
    device = values["means"].device
    viewmat = torch.eye(4, device=device)
    viewmat[2, 3] = 5.0
    K = torch.tensor([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]], device=device)
    inputs = {name: value.clone().requires_grad_(differentiate) for name, value in values.items()}
    out = rasterization_rgbt(*inputs.values(), viewmat[None], K[None], width, height, sh_degree=3)
    if differentiate:
        (out.render_colors.square().sum() + out.render_thermal_features.square().sum()).backward()
    return out.render_colors.detach().cpu()


def memory_in_use(device: torch.device) -> int:
    """Memory of this process [bytes]: resident, and what torch, which Warp takes arrays from, has on a GPU."""
    on_device = torch.cuda.memory_reserved(device) if device.type == "cuda" else 0
    status = Path("/proc/self/statm")
    if status.exists():
        return on_device + int(status.read_text().split()[1]) * resource.getpagesize()
    return on_device + resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def main() -> int:
    """Starts the threads, and watches them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=300.0, help="how long to render")
    parser.add_argument("--threads", type=int, default=20, help="threads that render")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    arguments = parser.parse_args()
    device = torch.device(arguments.device)
    torch.set_num_threads(1)
    values = scene(device)
    begin = time.monotonic()
    end = begin + arguments.seconds
    images: dict[tuple[int, int], torch.Tensor] = {}
    counts, errors = [0] * arguments.threads, []
    first = threading.Lock()

    def serve(place: int) -> None:
        choose = random.Random(place)
        try:
            while time.monotonic() < end and not errors:
                size = choose.choice(SIZES)
                image = render(values, size, counts[place] % 10 == 0)
                with first:
                    expected = images.setdefault(size, image)
                if not torch.equal(image, expected):
                    errors.append(f"thread {place} found another image of {size} pixels than the first thread.")
                counts[place] += 1
        except Exception as error:
            errors.append(f"thread {place}: {type(error).__name__}: {error}")

    threads = [threading.Thread(target=serve, args=(place,)) for place in range(arguments.threads)]
    for thread in threads:
        thread.start()
    settled: list[int] = []
    while any(thread.is_alive() for thread in threads):
        time.sleep(max(0.1, min(arguments.seconds / 20, 30.0)))
        used, now = memory_in_use(device), time.monotonic() - begin
        print(f"{now:7.0f} s  {sum(counts):8d} renders  {used / 2**20:8.1f} MiB", flush=True)
        if now > WARM_UP * arguments.seconds:
            settled.append(used)
    for thread in threads:
        thread.join()
    growth = max(settled) - settled[0] if settled else 0
    for error in errors:
        print(error, file=sys.stderr)
    if growth > GROWTH:
        print(f"Memory grew by {growth / 2**20:.1f} MiB after {WARM_UP:.0%} of the time.", file=sys.stderr)
    return 1 if errors or growth > GROWTH else 0


if __name__ == "__main__":
    sys.exit(main())
