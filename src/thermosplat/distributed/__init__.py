"""Several processes, each with a device of its own, that work on one scene: ranks of ``torch.distributed``."""
