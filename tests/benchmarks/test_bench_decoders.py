"""The decoders are timed as training runs them."""

import torch

from bench_decoders import random_case, variants


def test_backward_has_the_precision_of_the_variant() -> None:
    """Matrix products of the backward pass are as coarse as those of the forward pass; afterwards all is as before."""
    case = random_case(32, 4, 3, (8, 6), torch.device("cpu"))
    before, seen = torch.get_float32_matmul_precision(), {}
    for name, variant in variants(case.decoders).items():
        hook = case.render.register_hook(lambda _, name=name: seen.update({name: torch.get_float32_matmul_precision()}))
        case.forward_backward(variant)
        hook.remove()
    assert seen == {"torch, float32": "highest", "torch, tf32": "high"}
    assert torch.get_float32_matmul_precision() == before
