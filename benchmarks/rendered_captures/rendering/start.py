"""Mitsuba, started on a device."""

import os
from pathlib import Path

from thermosplat.errors import UserError

_NEEDED_LLVM = range(24, 18, -1)
"""Dr.Jit's versions of LLVM: 16 crashed while it compiled what Mitsuba 3.9 asks for, 19 works."""


def start(variant: str) -> None:
    """Import Mitsuba and choose its variant; once per process.

    Args:
        variant: ``llvm_ad_rgb`` for CPUs, ``cuda_ad_rgb`` for GPUs.

    Raises:
        UserError: Mitsuba or LLVM is missing, or the variant is unknown.
    """
    if variant.startswith("llvm") and "DRJIT_LIBLLVM_PATH" not in os.environ:
        found = next((path for version in _NEEDED_LLVM for path in _libraries(version)), None)
        if found is not None:
            os.environ["DRJIT_LIBLLVM_PATH"] = str(found)
    try:
        import mitsuba
    except ImportError as error:
        raise UserError("Captures are rendered by Mitsuba, which is not installed.", "pip install mitsuba") from error
    if variant not in mitsuba.variants() or variant.startswith("scalar"):
        raise UserError(
            f"There is no variant {variant!r} that renders these scenes.", "--variant llvm_ad_rgb or cuda_ad_rgb"
        )
    try:
        mitsuba.set_variant(variant)
        mitsuba.Float(1.0) + 1.0
    except Exception as error:
        raise UserError(
            f"Mitsuba's {variant} does not start here: {error}",
            "llvm_ad_rgb needs LLVM 19 or newer: apt install libllvm19, or DRJIT_LIBLLVM_PATH=libLLVM.so; "
            "cuda_ad_rgb needs an NVIDIA GPU.",
        ) from error
    mitsuba.set_log_level(mitsuba.LogLevel.Error)


def _libraries(version: int) -> list[Path]:
    """Where Debian and Ubuntu have LLVM's library."""
    patterns = (f"*/libLLVM*{version}*", f"llvm-{version}/lib/libLLVM*.so*")
    return [path for pattern in patterns for path in sorted(Path("/usr/lib").glob(pattern))]
