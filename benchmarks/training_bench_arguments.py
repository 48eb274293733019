"""The command line of bench_training.py, and what it takes on a GPU and on the CPU unless told otherwise."""

import argparse
import os
import sys
from pathlib import Path

from thermosplat.devices import choose_device

PARTS = ("whole", "peers", "step", "sample")

ON_CUDA = {
    "parts": ["whole", "peers", "step"],
    "sizes": ["640x480", "1280x1024"],
    "counts": [100_000, 300_000, 1_000_000],
    "start_steps": 2000,
    "windows": 5,
    "window": 200,
    "step_window": 50,
    "repeats": 20,
}
ON_CPU = {
    "parts": ["sample", "peers", "step"],
    "sizes": ["200x150"],
    "counts": [5_000, 20_000],
    "start_steps": 100,
    "windows": 3,
    "window": 10,
    "step_window": 5,
    "repeats": 5,
}


def parse(description: str, words: list[str] | None = None) -> argparse.Namespace:
    """The options; ``flags`` are those behind --, ``words`` all of them, and what is not given is the device's default.

    Args:
        description: For --help.
        words: The words; None: the process's.
    """
    words = sys.argv[1:] if words is None else words
    end = words.index("--") if "--" in words else len(words)
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", metavar="DATA", help="folder of a capture, or sample")
    parser.add_argument("--config", help="preset or YAML file; default: as thermosplat-train")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--parts", nargs="+", choices=PARTS, help=f"{_defaults('parts')}")
    parser.add_argument("--json", type=Path, help="file to write")
    parser.add_argument("--markdown", type=Path, help="file to write the tables to")
    parser.add_argument("--out", type=Path, help="folder to keep the trainings in; default: they are not kept")
    parser.add_argument("--time-limit", type=float, help="start no measurement after so long [s]")

    whole = parser.add_argument_group("whole")
    whole.add_argument("--seeds", type=int, nargs="+", default=[42])
    whole.add_argument(
        "--plain", action="store_true", help="also with --no-graph --no-compile, here and among the peers"
    )
    whole.add_argument("--deterministic", action="store_true", help="also with --deterministic, twice")

    peers = parser.add_argument_group("peers and step")
    peers.add_argument("--run", help="result folder of thermosplat-train with the Gaussians to take")
    peers.add_argument("--start-steps", type=int, help=f"without one: steps to train first; {_defaults('start_steps')}")
    peers.add_argument("--windows", type=int, help=f"windows of each; {_defaults('windows')}")
    peers.add_argument("--window", type=int, help=f"steps of a window; {_defaults('window')}")
    peers.add_argument("--no-gsplat", action="store_true", help="without gsplat")
    peers.add_argument(
        "--oracle",
        default=os.environ.get("THERMOSPLAT_TEST_ORACLE"),
        help="folder of gsplat_oracle.py, for gsplat on the CPU (README.md)",
    )
    peers.add_argument("--sizes", nargs="+", help=f"WIDTHxHEIGHT of random scenes; {_defaults('sizes')}")
    peers.add_argument("--counts", type=int, nargs="+", help=f"Gaussians of random scenes; {_defaults('counts')}")
    peers.add_argument("--no-data-case", action="store_true", help="step: random scenes alone, without DATA")
    peers.add_argument("--step-window", type=int, help=f"step: steps of a window; {_defaults('step_window')}")
    peers.add_argument("--repeats", type=int, help=f"step: measurements of a part; {_defaults('repeats')}")

    sample = parser.add_argument_group("sample")
    sample.add_argument("--cores", type=int, default=2, help="cores it may use; default 2")
    sample.add_argument("--warm-cache", action="store_true", help="with the user's compiled kernels, not without any")

    options = parser.parse_args(words[:end])
    options.flags, options.words = words[end + 1 :], words
    on_cuda = choose_device(options.device).type == "cuda"
    for name, value in (ON_CUDA if on_cuda else ON_CPU).items():
        if getattr(options, name) is None:
            setattr(options, name, value)
    return options


def _defaults(name: str) -> str:
    def text(value: object) -> str:
        return " ".join(map(str, value)) if isinstance(value, list) else str(value)

    return f"default {text(ON_CUDA[name])} on CUDA, {text(ON_CPU[name])} on the CPU"
