"""What would bound rendering on cards below an H100, on paper: occupancy from the compiler, times from measured floors.

    python benchmarks/estimate_cards.py [--archs 75 86 89 90 100 120] [--json cards.json]

Compiles projection and blending of both spectra, and their adjoints, for each architecture, which takes no GPU, and
reads registers and shared memory out of the cubins. Occupancy is the share of a multiprocessor's warps that fit, by
NVIDIA's limits (CUDA C++ Programming Guide, compute capabilities).

Times are bounds, no measurements: the stages of an H200 (records/rasterizer-speed.md, a million Gaussians eleven by
eleven, 1920x1080, both spectra) times the ratio of bandwidths, of arithmetic, or of both where the record does not
say which of them bounds.
"""

import argparse
import json
import tempfile
from dataclasses import dataclass
from pathlib import Path

import warp as wp

from measuring.cubin_resources import Resources, cubin_resources
from warp_kernels.blending.blend_layout import BlendLayout
from warp_kernels.blending.blend_variant import blend_variant
from warp_kernels.blending.blending import blend_kernel
from warp_kernels.blending.blending_adjoint import blend_adjoint_kernel
from warp_kernels.projection.projection import projection_kernel
from warp_kernels.projection.projection_adjoint import projection_adjoint_kernel

LAYOUT = BlendLayout(16, 8, 8, 32)
"""The deal of a crowded view (``default_layout``)."""
CHANNELS, THERMAL = 11, 8
"""RGB with 8 latent channels, 8 of heat."""
PER_GAUSSIAN = 256
"""Threads of a block of the kernels with one thread per Gaussian: Warp's default."""


@dataclass(frozen=True)
class Multiprocessor:
    """Limits of a compute capability."""

    warps: int
    blocks: int
    shared: int
    """[KiB]; below it 1 KiB of each block is the driver's, from 8.0 on."""
    registers: int = 65536

    def occupancy(self, used: Resources, threads: int, reserved: int) -> float:
        """Share of the warps that fit at once.

        Args:
            used: Of the kernel.
            threads: Of a block.
            reserved: Shared memory that each block takes besides [bytes].
        """
        warps = -(-threads // 32)
        per_warp = -(-used.registers * 32 // 256) * 256  # registers are given out in 256s
        fitting = min(self.warps // warps, self.blocks, self.registers // per_warp // warps)
        shared = used.shared + reserved
        if shared:
            fitting = min(fitting, self.shared * 1024 // shared)
        return fitting * warps / self.warps


MULTIPROCESSORS = {
    75: Multiprocessor(32, 16, 64),
    86: Multiprocessor(48, 16, 100),
    87: Multiprocessor(48, 16, 164),
    89: Multiprocessor(48, 24, 100),
    90: Multiprocessor(64, 32, 228),
    100: Multiprocessor(64, 32, 228),
    120: Multiprocessor(48, 24, 100),
}


@dataclass(frozen=True)
class Card:
    """A card's figures."""

    bandwidth: float
    """[GB/s]."""
    multiply_adds: float
    """Of float32 [10^9/s]."""


MEASURED = Card(4172.0, 25631.0)
"""The H200 that was measured."""
CARDS = {
    "RTX 4090": Card(1008.0, 41290.0),
    "RTX 4060": Card(272.0, 7555.0),
    "AGX Orin 64 GB": Card(204.8, 2662.0),
}
"""The vendor's figures: half the TFLOP/s of float32."""
STAGES = {
    "projection": 0.315,
    "colours": 0.247,
    "binning": 1.042,
    "blending": 1.160,
    "blending adjoint": 2.144,
    "colours adjoint": 1.190,
    "projection adjoint": 0.472,
}
"""On the H200 [ms], garden x121 at 1920x1080, both spectra. records/rasterizer-speed.md."""
BY_ARITHMETIC = {"blending", "blending adjoint"}


def kernels() -> dict[str, tuple[wp.Kernel, int]]:
    """The kernels by what they do, with the threads of a block."""
    variant = blend_variant(CHANNELS, THERMAL, wp.float32, LAYOUT)
    return {
        "projection": (projection_kernel(wp.float32, "pinhole", False), PER_GAUSSIAN),
        "projection adjoint": (
            projection_adjoint_kernel(wp.float32, "pinhole", False, False, False),
            PER_GAUSSIAN,
        ),
        "blending": (blend_kernel(variant), LAYOUT.threads),
        "blending adjoint": (blend_adjoint_kernel(variant, False, False), LAYOUT.threads),
    }


def compiled(kernel: wp.Kernel, arch: int) -> Resources:
    """What the kernel takes on an architecture."""
    with tempfile.TemporaryDirectory() as folder:
        wp.compile_aot_module(kernel.module, arch=arch, module_dir=folder, use_ptx=False)
        (cubin,) = Path(folder).glob("*.cubin")
        found = cubin_resources(cubin)
    named = [used for name, used in found.items() if name.startswith(kernel.key) and "forward" in name]
    return max(named, key=lambda used: used.registers)


def slower(card: Card, stage: str) -> tuple[float, float]:
    """How many times an H200's time the stage takes at least, and at most, by bandwidth and by arithmetic."""
    ratios = MEASURED.bandwidth / card.bandwidth, MEASURED.multiply_adds / card.multiply_adds
    return (min(ratios), max(ratios)) if stage in BY_ARITHMETIC else (ratios[0], ratios[0])


def main() -> None:
    """Compile, count and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--archs", type=int, nargs="+", choices=MULTIPROCESSORS, default=[75, 86, 89, 90, 100, 120])
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    wp.init()
    rows = []
    print("| kernel | compute capability | registers | shared [bytes] | local [bytes] | occupancy |")
    print("|---|---|---|---|---|---|")
    for name, (kernel, threads) in kernels().items():
        for arch in options.archs:
            used = compiled(kernel, arch)
            share = MULTIPROCESSORS[arch].occupancy(used, threads, 1024 if arch >= 80 else 0)
            rows.append({"kernel": name, "arch": arch, **vars(used), "occupancy": share})
            shape = f"{used.registers} | {used.shared:,} | {used.local}"
            print(f"| {name} | {arch // 10}.{arch % 10} | {shape} | {share:.0%} |", flush=True)
    print("\n| stage | H200, measured [ms] | " + " | ".join(f"{card} [ms]" for card in CARDS) + " |")
    print("|---|---|" + "---|" * len(CARDS))
    sums = {name: [0.0, 0.0] for name in CARDS}
    for stage, ms in STAGES.items():
        cells = []
        for name, card in CARDS.items():
            low, high = (ms * ratio for ratio in slower(card, stage))
            sums[name] = [sums[name][0] + low, sums[name][1] + high]
            cells.append(_span(low, high))
        print(f"| {stage} | {ms:.2f} | " + " | ".join(cells) + " |")
    print(f"| all | {sum(STAGES.values()):.2f} | " + " | ".join(_span(*sums[name]) for name in CARDS) + " |")
    if options.json is not None:
        options.json.write_text(json.dumps({"kernels": rows, "milliseconds": sums}) + "\n")


def _span(low: float, high: float) -> str:
    return f"{low:.1f}" if high - low < 0.05 else f"{low:.1f} to {high:.1f}"


if __name__ == "__main__":
    main()
