"""What does a plain call cost the host? Calls of Python functions and milliseconds of a scene in which all is host.

    python benchmarks/bench_call_overhead.py --functions 20
    git worktree add ../before fcaeaed && python benchmarks/bench_call_overhead.py --beside ../before

A frame of 64 Gaussians and 16x16 pixels on the CPU: its kernels take some twenty microseconds, and everything else is
what a call of ``rasterization`` or ``rasterization_rgbt`` costs in any frame, on CUDA too. Each source tree has a
process of its own, and they take turns.
"""

import argparse
import cProfile
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import CodeType
from typing import IO, Any, cast

ROOT = Path(__file__).resolve().parents[1]
GAUSSIANS, SIZE, FEATURES = 64, 16, 8
CALLS = 20
"""Timed calls of each pass in a turn."""


def passes() -> dict[str, Callable[[], object]]:
    """What is measured, by name."""
    import torch

    from thermosplat import rasterization, rasterization_rgbt

    n, rng = GAUSSIANS, torch.Generator().manual_seed(0)
    means, scales = torch.rand(n, 3, generator=rng) - 0.5, 0.05 * torch.rand(n, 3, generator=rng)
    quats, coefficients = torch.randn(n, 4, generator=rng), 0.1 * torch.randn(n, 16, 3, generator=rng)
    opacities, thermal_opacities = torch.rand(2, n, generator=rng)
    features = torch.rand(n, FEATURES, generator=rng)
    viewmats, Ks = torch.eye(4)[None], torch.tensor([[[16.0, 0.0, 8.0], [0.0, 16.0, 8.0], [0.0, 0.0, 1.0]]])
    viewmats[:, 2, 3] = 2.0
    gaussians = [means, quats, scales, opacities, coefficients, thermal_opacities, features]
    learnt = [tensor.requires_grad_() for tensor in gaussians]

    def rgb() -> tuple[Any, ...]:
        return rasterization(*learnt[:5], viewmats, Ks, SIZE, SIZE, sh_degree=3)[:2]

    def rgbt() -> tuple[Any, ...]:
        thermal = (learnt[5], *learnt[4:5], learnt[6])
        return rasterization_rgbt(*learnt[:4], *thermal, viewmats, Ks, SIZE, SIZE, sh_degree=3)[:3]

    def forward(render: Callable[[], tuple[Any, ...]]) -> Callable[[], object]:
        def call() -> object:
            with torch.no_grad():
                return render()

        return call

    def both(render: Callable[[], tuple[Any, ...]]) -> Callable[[], object]:
        read = learnt[:5] if render is rgb else learnt

        def call() -> object:
            colors, *others = render()
            loss = colors.sum()
            for image in others:
                loss = loss + image.sum()
            return torch.autograd.grad(loss, read)

        return call

    return {
        "rgb, forward": forward(rgb),
        "rgb, with backward": both(rgb),
        "rgbt, forward": forward(rgbt),
        "rgbt, with backward": both(rgbt),
    }


def called(call: Callable[[], object]) -> tuple[Counter[str], Counter[str]]:
    """How often functions of Python, by file, line and name, and those that are built in are called in one call.

    The call is made a few times before, with which kernels are compiled and caches filled.
    """
    for _ in range(3):
        call()
    profile = cProfile.Profile()
    profile.enable()
    call()
    profile.disable()
    python, builtin = Counter[str](), Counter[str]()
    for entry in profile.getstats():
        code = entry.code
        if isinstance(code, CodeType):
            python[f"{code.co_filename}:{code.co_firstlineno} {code.co_name}"] += entry.callcount
        else:
            builtin[str(code)] += entry.callcount
    return python, builtin


def work() -> None:
    """A worker: first what calls call, then times, one line of JSON for each line that is read."""
    import torch

    torch.set_num_threads(1)
    measured, counts = passes(), {}
    for name, call in measured.items():
        python, builtin = called(call)
        counts[name] = {"python": python, "builtin": builtin}
    print(json.dumps(counts), flush=True)
    for _ in sys.stdin:
        found: dict[str, dict[str, float]] = {}
        for name, call in measured.items():
            clocks: list[list[float]] = []
            for _ in range(CALLS):
                wall, own = time.perf_counter(), time.thread_time()
                call()
                clocks.append([1e3 * (time.perf_counter() - wall), 1e3 * (time.thread_time() - own)])
            found[name] = dict(zip(("wall", "own"), map(min, zip(*clocks, strict=True)), strict=True))
        print(json.dumps(found), flush=True)


def measure(trees: dict[str, Path], turns: int) -> dict[str, dict[str, Any]]:
    """Calls and times of each source tree.

    Args:
        trees: Folders of this repository's checkouts, by name.
        turns: How often each tree is timed; who begins changes from turn to turn.

    Returns:
        By tree ``calls``, by pass the counts of ``called``, and ``times``, by pass the fastest call of each turn [ms],
        to which whatever else runs on the machine adds least: ``wall`` on the clock, and ``own``, of the thread alone.
    """
    workers = {}
    for name, tree in trees.items():
        environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tree), str(tree / "src")])}
        workers[name] = subprocess.Popen(
            [sys.executable, "-P", __file__, "--worker"],
            env=environment,
            cwd=tree,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
    try:
        found: dict[str, dict[str, Any]] = {}
        for name, worker in workers.items():
            found[name] = {"calls": _answer(worker), "times": {}}
        for turn in range(turns):
            for name in list(workers)[:: 1 if turn % 2 == 0 else -1]:
                for kind, clocks in _answer(workers[name], "\n").items():
                    of_pass = found[name]["times"].setdefault(kind, {"wall": [], "own": []})
                    for clock, value in clocks.items():
                        of_pass[clock].append(value)
    finally:
        for worker in workers.values():
            worker.kill()
            worker.wait()
    return found


def _answer(worker: "subprocess.Popen[str]", asked: str = "") -> Any:
    """What a worker says, or why there is nothing."""
    asking, answering = cast("IO[str]", worker.stdin), cast("IO[str]", worker.stdout)
    if asked:
        asking.write(asked)
        asking.flush()
    line = answering.readline()
    if not line:
        raise SystemExit(f"The measuring process ended with exit code {worker.wait()}; its message is above.")
    return json.loads(line)


def table(found: dict[str, dict[str, Any]]) -> list[str]:
    """Lines of Markdown: a row for each pass and tree; ratios are of the first tree to the last."""
    lines = [
        "| pass | tree | calls of Python functions | and of built-in ones | ms | ms of processor time |",
        "|---|---|---|---|---|---|",
    ]
    first, last = found[next(iter(found))], found[list(found)[-1]]
    for kind in first["calls"]:
        for name, of_tree in found.items():
            counts, clocks = of_tree["calls"][kind], of_tree["times"][kind]
            python, builtin = (sum(counts[key].values()) for key in ("python", "builtin"))
            wall, own = (statistics.median(clocks[clock]) for clock in ("wall", "own"))
            lines.append(f"| {kind} | {name} | {python:,} | {builtin:,} | {wall:.3f} | {own:.3f} |")
        if len(found) > 1:
            python, builtin = (
                sum(first["calls"][kind][key].values()) / sum(last["calls"][kind][key].values())
                for key in ("python", "builtin")
            )
            ratios = (_ratio(first["times"][kind][clock], last["times"][kind][clock]) for clock in ("wall", "own"))
            lines.append(f"| | ratio | {python:.2f} | {builtin:.2f} | {' | '.join(ratios)} |")
    return lines


def _ratio(ours: list[float], others: list[float]) -> str:
    """Median ratio of the turns, and its standard error as of normal numbers with these quartiles."""
    ratios = [a / b for a, b in zip(ours, others, strict=True)]
    low, median, high = statistics.quantiles(ratios, n=4, method="inclusive")
    return f"{median:.3f} ± {1.2533 * (high - low) / 1.349 / len(ratios) ** 0.5:.3f}"


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--beside", type=Path, default=None, help="another checkout of this repository")
    parser.add_argument("--turns", type=int, default=60, help=f"times that a tree is timed, {CALLS} calls each")
    parser.add_argument("--functions", type=int, default=0, help="so many functions that are called most")
    parser.add_argument("--json", type=Path, default=None, help="file to write")
    options = parser.parse_args()
    if options.worker:
        return work()
    trees = {"this": ROOT} | ({options.beside.name: options.beside.resolve()} if options.beside is not None else {})
    found = measure(trees, options.turns)
    print(f"{time.strftime('%Y-%m-%d')}, {platform.machine()} CPU, Python {platform.python_version()}")
    print("\n".join(["", *table(found)]))
    for name, of_tree in found.items() if options.functions else ():
        for kind, counts in of_tree["calls"].items():
            most = Counter(counts["python"]) + Counter(counts["builtin"])
            print(f"\n{name}, {kind}:")
            print("\n".join(f"{count:5} {function}" for function, count in most.most_common(options.functions)))
    if options.json is not None:
        options.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
