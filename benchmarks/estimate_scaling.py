"""What would limit a training on 8 GPUs, and on 4 hosts of 8, on paper: bytes exchanged against the speed of links.

    python benchmarks/estimate_scaling.py
    python benchmarks/estimate_scaling.py --seen 0.3 --step-ms 5.85 --count 1000000

Nothing is measured here but the bytes that a Gaussian takes between ranks, which a call of the renderer sends. The time
of a step on one GPU is a measured one: 5.85 ms for a million Gaussians at 1280x1024 on an H200
(records/training-steps.md). Links are the vendors' figures for one direction, and a share of them is taken to be
reached.

A step of W ranks renders W views. A camera sees the share ``--seen`` of N Gaussians, and of those (W - 1) / W are on
other ranks; a rank receives so many rows and their gradients' way back is as long. The work of a rank is taken to be
that of one GPU: it blends a view of its own, and projects a W-th of the Gaussians to W cameras. (Adam and the penalties
are divided by W, which is not counted.)
"""

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
import torch.distributed as dist

from measuring.exchanged_bytes import counted_bytes
from measuring.ranks import on_ranks
from thermosplat import rasterization_rgbt

FEATURES = 8
"""Latent channels. ThermoSplat."""


@dataclass(frozen=True)
class Cluster:
    """Ranks and the links between them."""

    name: str
    hosts: int
    gpus: int
    """Of a host."""
    inside: float
    """Between GPUs of a host, one direction, of each GPU [GB/s]."""
    outside: float
    """Between hosts, one direction, of each GPU [GB/s]."""


CLUSTERS = (
    Cluster("2 GPUs, NVLink", 1, 2, 450.0, 0.0),  # NVIDIA H200: 900 GB/s both ways
    Cluster("8 GPUs, NVLink", 1, 8, 450.0, 0.0),
    Cluster("8 GPUs, PCIe 5", 1, 8, 64.0, 0.0),  # x16, one direction
    Cluster("4 hosts x 8, 400 Gb/s per GPU", 4, 8, 450.0, 50.0),  # DGX H200: eight ConnectX-7
    Cluster("4 hosts x 8, 100 Gb/s per host", 4, 8, 450.0, 12.5 / 8),
)


def bytes_per_row() -> tuple[float, float]:
    """Bytes that a Gaussian seen by a camera takes to its rank, and its gradients take back: counted in a call."""
    with TemporaryDirectory() as folder:
        on_ranks(2, count_bytes, folder)
        forward, backward = json.loads((Path(folder) / "bytes.json").read_text())
    return forward, backward


def count_bytes(rank: int, folder: str) -> None:
    """One of two ranks, whose Gaussians both cameras see."""
    dist.init_process_group("gloo", store=dist.FileStore(f"{folder}/store", 2), rank=rank, world_size=2)
    n = 1000
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(n, 3, generator=generator) + torch.tensor([-0.5, -0.5, 3.0])
    means.requires_grad_()
    with counted_bytes() as forward:
        out = rasterization_rgbt(
            means,
            torch.rand(n, 4, generator=generator),
            torch.full((n, 3), 0.02),
            torch.full((n,), 0.5),
            torch.full((n,), 0.5),
            torch.rand(n, 1, 3, generator=generator),
            torch.rand(n, FEATURES, generator=generator),
            torch.eye(4)[None],
            torch.tensor([[[64.0, 0.0, 32.0], [0.0, 64.0, 32.0], [0.0, 0.0, 1.0]]]),
            64,
            64,
            sh_degree=0,
            distributed=True,
        )
    with counted_bytes() as backward:
        out.render_colors.sum().backward()
    rows = int(out.info["visible"][1 - rank].sum())
    if rank == 0:
        (Path(folder) / "bytes.json").write_text(json.dumps([forward.bytes / rows, backward.bytes / rows]))
    dist.barrier()


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=1_000_000, help="Gaussians that --step-ms is of")
    parser.add_argument("--step-ms", type=float, default=5.85, help="a step of one view on one GPU")
    parser.add_argument("--seen", type=float, default=0.5, help="share of the Gaussians that a camera sees")
    parser.add_argument("--reached", type=float, default=0.7, help="share of a link's speed that is reached")
    parser.add_argument("--call-us", type=float, default=60.0, help="one collective call, beside its bytes")
    options = parser.parse_args()
    forward, backward = bytes_per_row()
    print(f"A Gaussian that a camera sees takes {forward:.0f} bytes to its rank, its gradients {backward:.0f}.")
    print()
    print("| ranks | received per rank and step | exchange | calls | work of a rank | images/s | of linear |")
    print("|---|---|---|---|---|---|---|")
    for cluster in CLUSTERS:
        print(row(cluster, options, forward + backward))


def row(cluster: Cluster, options: argparse.Namespace, bytes_both_ways: float) -> str:
    """The table's row of a cluster."""
    ranks = cluster.hosts * cluster.gpus
    rows = options.seen * options.count
    from_host, from_others = rows * (cluster.gpus - 1) / ranks, rows * (ranks - cluster.gpus) / ranks
    received = (from_host + from_others) * bytes_both_ways
    speed = 1e9 * options.reached
    exchange = from_host * bytes_both_ways / (cluster.inside * speed)
    if from_others:
        exchange += from_others * bytes_both_ways / (cluster.outside * speed)
    calls = 10 * options.call_us * 1e-6 * (1 if cluster.hosts == 1 else 2)  # four forward, three backward, three sums
    alone = options.step_ms * 1e-3
    total = exchange + calls + alone
    images = ranks / total
    return (
        f"| {cluster.name} | {received / 1e6:.0f} MB | {exchange * 1e3:.2f} ms | {calls * 1e3:.2f} ms | "
        f"{alone * 1e3:.2f} ms | {images:,.0f} | {images * alone / ranks:.0%} |"
    )


if __name__ == "__main__":
    main()
