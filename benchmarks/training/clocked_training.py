"""thermosplat-train with a clock on the compilation of kernels: what bench_training.py runs in processes of their own.

    python benchmarks/training/clocked_training.py FILE DATA [flags of thermosplat-train]

Writes to FILE (JSON) the seconds in which Warp compiled kernels, in all and after the first step: another layout of the
blending kernels, say, is compiled when the scene first asks for it. The decoders' in the first step.
"""

import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from thermosplat.cli.train import main


class CompilationClock:
    """Notes when Warp compiles, and when the first step of a training ends."""

    def __init__(self) -> None:
        self.compiled: list[tuple[float, float]] = []
        self.first_step_end: float | None = None

    def install(self) -> None:
        """Put the clock around Warp's compiler and around the trainer's first step."""
        from warp._src.context import Module

        from thermosplat.training.session.run_logger import RunLogger

        Module._compile = self._clocked(Module._compile)
        compiling = RunLogger.compiling

        @contextmanager
        def first_step(logger: RunLogger) -> Iterator[None]:
            with compiling(logger):
                yield
            self.first_step_end = time.perf_counter()

        RunLogger.compiling = first_step  # type: ignore[method-assign]

    def seconds(self) -> dict[str, float]:
        """Seconds of compilation in all, and after the first step."""
        end = self.first_step_end
        return {
            "compile_s": sum(seconds for _, seconds in self.compiled),
            "late_compile_s": sum(seconds for start, seconds in self.compiled if end is not None and start >= end),
        }

    def _clocked(self, compile_module: Callable[..., bool]) -> Callable[..., bool]:
        def clocked(*arguments: Any, **options: Any) -> bool:
            started = time.perf_counter()
            done = compile_module(*arguments, **options)
            if done:  # else it was found in the cache
                self.compiled.append((started, time.perf_counter() - started))
            return done

        return clocked


if __name__ == "__main__":
    clock = CompilationClock()
    clock.install()
    code = main(sys.argv[2:])
    Path(sys.argv[1]).write_text(json.dumps(clock.seconds()), encoding="utf-8")
    sys.exit(code)
