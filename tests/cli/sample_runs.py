"""What the tests of the commands share: short runs on the sample capture, and how a command is run."""

from collections.abc import Callable

QUICK = ["--data-factor", "4", "--device", "cpu", "--no-tensorboard", "--log-every", "1"]
STEPS = 3

Outcome = tuple[int, str]
Run = Callable[..., Outcome]
