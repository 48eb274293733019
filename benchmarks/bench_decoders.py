"""How fast are the decoders, and how exact? Fused kernels beside plain PyTorch and torch.compile.

    python benchmarks/bench_decoders.py --sizes 400x300 640x480 --json decoders.json --markdown decoders.md
    python benchmarks/bench_decoders.py --device cpu --sizes 320x240

Both branches of random networks on random features, forward without gradients and forward plus backward; the error of
images and gradients against the same networks in float64. On CUDA each call is a graph, as in a training step, so that
launching is not timed. README.md says more.
"""

import argparse
import copy
import functools
import json
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from measuring.agreement import largest
from measuring.timing import time_interleaved
from rasterization.case import one_line
from thermosplat.config import DecoderConfig
from thermosplat.runs.atomic_writes import write_text
from thermosplat.runs.devices import choose_device
from thermosplat.runs.environment import environment
from thermosplat.scene.decoder import Decode, Decoders
from thermosplat.spectra import DEFAULT_SPECTRA, ColorSpace, model_spectra
from thermosplat.training.fast_decoders import FastDecoders, FusedDecoders, can_compile, teams

WARM_UP = 3

Images = Sequence[Tensor]
MODULATED, PRIOR = "rgb", "thermal"
"""The spectrum that is modulated, and the one whose prior modulates it."""


class Variant(NamedTuple):
    """A way to decode both branches.

    Attributes:
        decode: Features by spectrum to images.
        active: Opened around a whole pass: the precision of matrix products holds backward too, as in a training step.
    """

    decode: Decode
    active: Callable[[], AbstractContextManager[None]] = nullcontext


class Case(NamedTuple):
    """What is decoded.

    Attributes:
        decoders: The networks.
        render: Three other channels and the visible features behind them, shape [H, W, 3 + d].
        thermal: Thermal features, shape [H, W, d].
        upstream: Gradients of both images.
    """

    decoders: Decoders
    render: Tensor
    thermal: Tensor
    upstream: list[Tensor]

    def double(self) -> "Case":
        """The same in float64."""
        leaves = [leaf.detach().double().requires_grad_() for leaf in (self.render, self.thermal)]
        return Case(copy.deepcopy(self.decoders).double(), *leaves, [v.double() for v in self.upstream])

    def images(self, variant: Variant) -> Images:
        """Both images."""
        decoded = variant.decode({MODULATED: self.render[..., 3:], PRIOR: self.thermal})
        return [decoded[MODULATED], decoded[PRIOR]]

    def forward(self, variant: Variant) -> Images:
        """Both images, without gradients."""
        with torch.no_grad(), variant.active():
            return self.images(variant)

    def forward_backward(self, variant: Variant) -> list[Tensor]:
        """Both images, then the gradients of features and parameters."""
        with variant.active():
            images = self.images(variant)
            leaves = [self.render, self.thermal, *self.decoders.parameters()]
            gradients = torch.autograd.grad(images, leaves, self.upstream)
        return [*(image.detach() for image in images), *gradients]


def arguments() -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--sizes", nargs="+", default=["400x300", "640x480", "1280x1024"], help="WIDTHxHEIGHT ...")
    parser.add_argument("--hidden", type=int, nargs="+", default=[64], help="channels of hidden layers")
    parser.add_argument("--features", type=int, default=8, help="channels of the features")
    parser.add_argument("--thermal-channels", type=int, choices=(1, 3), default=3)
    parser.add_argument("--repeats", type=int, default=None, help="measurements of each (50 on CUDA, 11 on the CPU)")
    parser.add_argument("--truth-pixels", type=int, default=640 * 480, help="compare with float64 up to so many")
    parser.add_argument("--json", type=Path, default=None, help="file to write")
    parser.add_argument("--markdown", type=Path, default=None, help="file to write the table to")
    return parser.parse_args()


def random_case(hidden: int, dim: int, thermal_channels: int, size: tuple[int, int], device: torch.device) -> Case:
    """Networks whose modulation does something, and gradients as small as those of a mean."""
    generator = torch.Generator().manual_seed(0)
    width, height = size
    kinds: dict[str, ColorSpace] = {MODULATED: "photograph", PRIOR: "scalar" if thermal_channels == 1 else "color"}
    decoders = Decoders(DecoderConfig(hidden_dim=hidden), dim, model_spectra(DEFAULT_SPECTRA, kinds))
    for parameter in decoders.parameters():
        torch.nn.init.normal_(parameter, std=0.3, generator=generator)

    def noise(channels: int) -> Tensor:
        return torch.randn(height, width, channels, generator=generator).to(device)

    leaves = [noise(channels).requires_grad_() for channels in (3 + dim, dim)]
    upstream = [noise(channels) / (width * height) for channels in (3, thermal_channels)]
    return Case(decoders.to(device), *leaves, upstream)


def variants(decoders: Decoders) -> dict[str, Variant]:
    """By name every way there is on the decoders' device to decode both branches."""
    on_cuda = next(decoders.parameters()).device.type == "cuda"
    found: dict[str, Variant] = {}
    for precision in ("float32", "tf32"):
        eager = FastDecoders(decoders, compiled=False, precision=precision)
        found[f"torch, {precision}"] = Variant(eager.decode, eager.precise)
    if on_cuda and can_compile():
        tf32 = FastDecoders(decoders, compiled=False, precision="tf32")
        found["torch.compile, tf32"] = Variant(torch.compile(decoders.decode, dynamic=False), tf32.precise)
    for team in teams(decoders):
        share = "a warp for 16 pixels" if team == 1 else f"{team} warps share 16 pixels"
        found[f"fused, {share}"] = Variant(FusedDecoders(decoders, team).decode)
    return found


def errors(results: list[Tensor], truth: list[Tensor]) -> dict[str, float]:
    """Largest relative difference (norm) of an image, and of a gradient."""
    apart = [float((a.double() - b).norm() / b.norm()) for a, b in zip(results, truth, strict=True)]
    return {"images": largest(apart[:2]), "gradients": largest(apart[2:])}


def as_graph(call: Callable[[], object], device: torch.device) -> Callable[[], object]:
    """On CUDA the replay of a graph of the call; elsewhere the call."""
    if device.type != "cuda":
        return call
    stream = torch.cuda.Stream(device)
    stream.wait_stream(torch.cuda.current_stream(device))
    with torch.cuda.stream(stream):
        for _ in range(WARM_UP):
            call()
    torch.cuda.current_stream(device).wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        call()
    return graph.replay


def run_case(case: Case, repeats: int, truth_pixels: int) -> dict[str, Any]:
    """Times and errors of every variant; one that fails is left out, with the reason."""
    device = case.render.device
    row: dict[str, Any] = {"errors": {}, "left_out": {}}
    calls: dict[str, dict[str, Callable[[], object]]] = {"forward": {}, "forward_backward": {}}
    truth = None
    if case.render.shape[0] * case.render.shape[1] <= truth_pixels:
        exact = case.double()
        truth = exact.forward_backward(Variant(exact.decoders.decode))
    for name, variant in variants(case.decoders).items():
        try:
            results = case.forward_backward(variant)
            captured = {kind: as_graph(functools.partial(getattr(case, kind), variant), device) for kind in calls}
        except Exception as error:  # one variant that fails (out of memory, say) must not lose the others
            traceback.print_exc()
            row["left_out"][name] = one_line(error)
            continue
        row["errors"][name] = errors(results, truth) if truth is not None else None
        for kind, call in captured.items():
            calls[kind][name] = call
    hide_host = device.type == "cuda"
    return row | {kind: time_interleaved(named, device, repeats, hide_host=hide_host) for kind, named in calls.items()}


def table_rows(report: dict[str, Any]) -> list[list[str]]:
    """A row a variant: networks, size, name, times [ms], errors."""
    cells = []
    for row in report["rows"]:
        for name, forward in row["forward"].items():
            error = row["errors"][name]
            apart = [f"{error[kind]:.1e}" for kind in ("images", "gradients")] if error else ["-", "-"]
            times = [f"{times['median_ms']:.3f}" for times in (forward, row["forward_backward"][name])]
            cells.append([str(row["hidden"]), row["size"], name, *times, *apart])
    return cells


def markdown(report: dict[str, Any]) -> str:
    """The report as a table."""
    head = ["hidden", "size", "decoders", "forward [ms]", "forward + backward [ms]", "error of images", "of gradients"]
    machine = report["environment"]
    lines = [f"{report['date']}, {machine['device']}, torch {machine['packages']['torch']}. `{report['command']}`", ""]
    lines += [f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *table_rows(report))]
    left_out = [(row, name, why) for row in report["rows"] for name, why in row["left_out"].items()]
    lines += ["", *(f"- {row['size']}, {name}: {why}" for row, name, why in left_out)]
    return "\n".join(lines).rstrip() + "\n"


def save(report: dict[str, Any], options: argparse.Namespace) -> None:
    """Replaces the files, so that they are whole at any time."""
    texts = ((options.json, json.dumps(report, indent=1) + "\n"), (options.markdown, markdown(report)))
    for path, text in texts:
        if path is not None:
            write_text(path, text)


def main() -> int:
    """Runs the cases asked for; returns 1 if a variant failed."""
    options = arguments()
    device = choose_device(options.device)
    repeats = options.repeats or (50 if device.type == "cuda" else 11)
    report: dict[str, Any] = {
        "command": " ".join(["python", "benchmarks/bench_decoders.py", *sys.argv[1:]]),
        "date": time.strftime("%Y-%m-%d"),
        "environment": environment(device),
        "rows": [],
    }
    for hidden in options.hidden:
        for size in options.sizes:
            width, height = (int(number) for number in size.lower().split("x"))
            case = random_case(hidden, options.features, options.thermal_channels, (width, height), device)
            row = {"hidden": hidden, "size": size} | run_case(case, repeats, options.truth_pixels)
            report["rows"].append(row)
            save(report, options)
            for cells in table_rows(report | {"rows": [row]}):
                print("{:>3} {:>10} {:<32} {:>9} {:>9} {:>9} {:>9}".format(*cells), flush=True)
            if device.type == "cuda":
                torch.cuda.empty_cache()  # of the graphs, each of which had its own
    return int(any(row["left_out"] for row in report["rows"]))


if __name__ == "__main__":
    sys.exit(main())
