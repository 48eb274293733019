"""Kernels compiled ahead are all that a step launches."""

from pathlib import Path

import pytest

from forked_processes import run_python
from warp_kernels.step_kernels import cpu_step_kernels

pytestmark = pytest.mark.rotating

STEP = """
import sys
import torch
import warp as wp
from thermosplat.rasterizer.pair_capacity import PairCapacity
from thermosplat.rasterizer import rasterization_rgbt
from warp_kernels.step_kernels import compile_for_cpu, cpu_step_kernels, must_compile_for_cpu

dual = sys.argv[1] == "True"
wp.init()
kernels = cpu_step_kernels(11, 8 if dual else 0)
compile_for_cpu(kernels)
assert not must_compile_for_cpu(kernels)
cache, wp.config.kernel_cache_dir = wp.config.kernel_cache_dir, sys.argv[2]
assert must_compile_for_cpu(kernels)
wp.config.kernel_cache_dir = cache
ahead = {kernel.module.name for kernel in kernels}
launched = {module.name for module in wp._src.context.user_modules.values() if module.execs}
assert launched == ahead, launched ^ ahead

generator = torch.Generator().manual_seed(0)
N = 50
values = {
    "means": torch.randn(N, 3, generator=generator), "quats": torch.randn(N, 4, generator=generator),
    "scales": 0.1 + torch.rand(N, 3, generator=generator), "opacities": torch.rand(N, generator=generator),
    "thermal_opacities": torch.rand(N, generator=generator) if dual else None,
    "colors": torch.randn(N, 16, 3, generator=generator), "features": torch.randn(N, 8, generator=generator),
}
values = {name: value if value is None else value.requires_grad_() for name, value in values.items()}
viewmat = torch.eye(4)
viewmat[2, 3] = 5.0
K = torch.tensor([[30.0, 0, 16], [0, 30.0, 12], [0, 0, 1]])
with PairCapacity("cpu").step(fixed=False):
    out = rasterization_rgbt(*values.values(), viewmat[None], K[None], 32, 24, sh_degree=3)
images = [image for image in (out.render_colors, out.render_features, out.render_thermal_features) if image is not None]
sum(image.square().sum() for image in images).backward()
assert values["means"].grad.abs().sum() > 0
launched = {module.name for module in wp._src.context.user_modules.values() if module.execs}
assert launched == ahead, launched ^ ahead
"""


def test_what_one_traversal_cannot_blend_is_not_compiled() -> None:
    """More channels are blended in several, by kernels of fewer; the others are the same."""
    few, many = ({kernel.key for kernel in cpu_step_kernels(*channels)} for channels in ((19, 13), (19, 16)))
    assert few > many
    assert len(few - many) == 3


@pytest.mark.parametrize("dual", [True, False])
def test_a_step_compiles_nothing_else(dual: bool, tmp_path: Path) -> None:
    """In a fresh process, with one opacity or two, a step finds all its kernels compiled."""
    done = run_python("-c", STEP, str(dual), tmp_path)
    assert done.returncode == 0, done.stderr
