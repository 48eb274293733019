"""How many Gaussians fit into a GPU's memory while they are trained: bytes of tensors, counted.

    python benchmarks/estimate_memory.py
    python benchmarks/estimate_memory.py --memory 80 --ranks 1 8 --configs thermosplat 3dgs

The state of a training is made on the CPU, of a preset and the sample, and its tensors are counted: parameters, their
gradients, Adam's moments, and what density control keeps. All of them grow with the number of Gaussians and lie on the
device in every step. Several ranks divide them.

What a step holds beside them is not counted. On one H200 the peak of training thermosplat at 640x480 grew by 1,132
bytes for each Gaussian between 100,000 and a million random ones (records/training-steps.md), of which its state is
1,096. On several ranks it was never measured. There every rank projects its share to the cameras of all, so it holds a
projection for each Gaussian of the scene, whatever the number of ranks: at least the bytes of what is exchanged, both
ways, which estimate_scaling.py counts.

A second table says what a Gaussian takes on the device and in the host's memory with ``--offload``, in a step and where
density control adds Gaussians.

Images, decoders and what a recorded step reserves are not in these numbers, nor is what a refinement holds for a
moment.
"""

import argparse
from collections.abc import Iterable

import torch
from torch import Tensor

from estimate_scaling import bytes_per_row
from thermosplat.cli.arguments import parse_train_arguments
from thermosplat.datasets import load_capture
from thermosplat.scene.model import SceneModel
from thermosplat.training.offloading import STEP_BYTES, Offloaded, SetSize
from thermosplat.training.training_state import TrainingState

GIGABYTE = 1e9
CPU = torch.device("cpu")


def _bytes(tensors: Iterable[Tensor]) -> int:
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors)


def state_of(config_name: str) -> TrainingState:
    """The state at the start of a training of the sample.

    Args:
        config_name: A preset.
    """
    config = parse_train_arguments(["sample", "--config", config_name, "--device", "cpu", "--data-factor", "8"])
    capture = load_capture("sample", data_factor=8, test_every=config.test_every, spectra=config.spectra)
    return TrainingState(SceneModel.from_capture(config, capture, CPU), config, capture, CPU)


def offload_rows(config_name: str) -> list[str]:
    """Rows of the second table; of separate sets those of the first.

    Args:
        config_name: A preset.
    """
    model = state_of(config_name).model
    size = SetSize.of(model, next(iter(model.gaussian_sets)))._replace(number=1)
    kinds: dict[str, Offloaded] = {"off": "nothing", "moments": "moments", "on": "all"}
    rows = []
    for asked, kind in kinds.items():
        found = [size.on_device(kind, False), size.on_device(kind, True)]
        found += [size.on_host(kind, False), size.on_host(kind, True)]
        rows.append(f"| {config_name} | {asked} | {' | '.join(f'{number:,.0f}' for number in found)} |")
    return rows


def bytes_by_kind(config_name: str) -> dict[str, float]:
    """Bytes of a Gaussian in the state of a training, by what they are; of separate sets those of the first.

    Args:
        config_name: A preset.
    """
    state = state_of(config_name)
    name, gaussians = next(iter(state.gaussian_sets.items()))
    for parameter in gaussians.parameters():  # Adam has no moments before its first step
        parameter.grad = torch.zeros_like(parameter)
    for optimizer in state.optimizers[name].values():
        optimizer.step()
    moments = [
        value
        for optimizer in state.optimizers[name].values()
        for of_parameter in optimizer.state.values()
        for key, value in of_parameter.items()
        if key != "step"
    ]
    kinds = {
        "parameters": _bytes(gaussians.parameters()),
        "gradients": _bytes(parameter.grad for parameter in gaussians.parameters() if parameter.grad is not None),
        "moments": _bytes(moments),
        "density control": _bytes(state.strategies[name].state_dict().values()),
    }
    return {kind: number / len(gaussians) for kind, number in kinds.items()}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--configs", nargs="+", default=["thermosplat", "3dgs"], help="presets")
    parser.add_argument("--memory", type=float, default=16.0, help="of a GPU for Gaussians [GB]")
    parser.add_argument("--ranks", type=int, nargs="+", default=[1, 2, 8], help="numbers of GPUs")
    options = parser.parse_args()
    projected = sum(bytes_per_row())
    rows = {config: bytes_by_kind(config) for config in options.configs}
    columns = [*next(iter(rows.values())), "state", "with a step", "Gaussians per GB"]
    columns += [f"{options.memory:g} GB x {ranks}" for ranks in options.ranks]
    print(f"| preset | {' | '.join(columns)} |")
    print(f"|{'---|' * (len(columns) + 1)}")
    for config, kinds in rows.items():
        state = sum(kinds.values())
        cells = [f"{number:,.0f}" for number in (*kinds.values(), state, state + STEP_BYTES)]
        cells.append(f"{GIGABYTE / (state + STEP_BYTES):,.0f}")
        for ranks in options.ranks:
            of_rank = state / ranks + (STEP_BYTES if ranks == 1 else projected)
            cells.append(f"{options.memory * GIGABYTE / of_rank / 1e6:.1f} M")
        print(f"| {config} | {' | '.join(cells)} |")
    print("\n| preset | --offload | device, step | device, growing | host, step | host, growing |")
    print("|---|---|---|---|---|---|")
    for config in options.configs:
        print("\n".join(offload_rows(config)))


if __name__ == "__main__":
    main()
