"""Everything random in a training run, as a function of the seed and the step.

A stream is named by (seed, purpose, index) and starts afresh for each name, so nothing random carries a state from
step to step: a resumed run, and a step taken back, draw what the uninterrupted run would have drawn.
"""

import numpy as np
import torch

_PURPOSES = ("frame order", "split", "initialisation", "position noise")


def random_stream(seed: int, purpose: str, index: int = 0) -> torch.Generator:
    """A CPU generator for one purpose at one step or epoch.

    Args:
        seed: The run's seed, at least 0.
        purpose: "frame order", "split", "initialisation" or "position noise".
        index: Step or epoch, at least 0.
    """
    return start_stream(torch.Generator(), seed, purpose, index)


def start_stream(generator: torch.Generator, seed: int, purpose: str, index: int = 0) -> torch.Generator:
    """Let a generator, on any device, start the stream that ``random_stream`` names; each device draws its own numbers.

    The other arguments are those of ``random_stream``.
    """
    entropy = np.random.SeedSequence([seed, _PURPOSES.index(purpose), index])
    return generator.manual_seed(int(entropy.generate_state(1, np.uint64)[0] >> np.uint64(1)))
