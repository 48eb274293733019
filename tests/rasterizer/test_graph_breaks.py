"""Functions that torch.compile calls as they are."""

import subprocess
import sys

import torch
from torch._dynamo.testing import CompileCounter

from thermosplat.rasterizer.graph_breaks import not_compiled

RENDER = """
import sys
import torch
from thermosplat import rasterization

n = 4
gaussians = (torch.zeros(n, 3), torch.ones(n, 4), torch.ones(n, 3), torch.ones(n), torch.ones(n, 3))
rasterization(*gaussians, torch.eye(4)[None], torch.eye(3)[None], 16, 16)
assert "torch._dynamo" not in sys.modules
"""


def test_a_render_imports_no_compiler() -> None:
    """A program that compiles nothing does not wait for torch's compiler."""
    done = subprocess.run([sys.executable, "-c", RENDER], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_compiled_code_calls_the_function_as_it_is() -> None:
    """What is before and behind it is compiled, its own operations are not; arguments and name get through."""

    @not_compiled
    def logarithm(x: torch.Tensor, *, base: float) -> torch.Tensor:
        return x.log() / torch.tensor(base).log()

    def program(x: torch.Tensor) -> torch.Tensor:
        return logarithm(x.exp(), base=2.0).sin()

    assert logarithm.__name__ == "logarithm"
    torch._dynamo.reset()
    counter = CompileCounter()
    compiled, x = torch.compile(program, backend=counter), torch.linspace(0.0, 1.0, 5)
    for _ in range(2):
        assert torch.equal(compiled(x), program(x))
    assert (counter.frame_count, counter.op_count) == (2, 2)  # exp, and sin
